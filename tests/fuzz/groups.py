"""What is damaged: whole files of every format that is read, and how each of them is damaged."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import cv2
import damage
import numpy as np
import pycolmap
from hypothesis import strategies as st
from make_photos import exif_block, texture
from test_gpmf import COUNTS, gyro, mux, payload, telemetry
from test_gyro import GCSV
from test_models import Truth, openmvg, opensfm
from tiff_files import tiff_file

SEEDS = Path(__file__).with_name("seeds")
Files = dict[str, bytes]


@dataclass(frozen=True)
class Group:
    """A kind of input.

    Attributes
    ----------
    reader : str
        Of `child.READERS`.
    made : function
        Gives the strategy of its damaged files, by name.
    share : int
        Of 10,000 inputs.
    beside : function
        Gives files that stay whole.
    """

    reader: str
    made: Callable[[], st.SearchStrategy[Files]]
    share: int
    beside: Callable[[], Files] = field(default=dict)


def one_of(**files: st.SearchStrategy[bytes]) -> st.SearchStrategy[Files]:
    """One of some files, by names whose dots are written as "__"."""
    return st.one_of(
        *(made.map(lambda data, name=name: {name.replace("__", "."): data}) for name, made in files.items())
    )


def encoded(suffix: str, pixels: np.ndarray, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, pixels, options)[1])


def dumped(value: object) -> bytes:
    return json.dumps(value).encode()


# ---------------------------------------------------------------- solutions


@cache
def solution() -> dict:
    return json.loads((SEEDS / "solution.json").read_text())


@cache
def small_solution() -> dict:
    """Of photos of 64x48 pixels."""
    value = json.loads((SEEDS / "solution.json").read_text())
    for key in ("cameras", "rectified_cameras"):
        camera = {"width": 64, "height": 48, "K": [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]}
        value[key] = {name: dict(camera) for name in value[key]}
    return value


@cache
def small_photos() -> Files:
    return {
        f"photos/{image['name']}": bytes(cv2.imencode(".jpg", texture(64, 48, seed))[1])
        for seed, image in enumerate(small_solution()["images"])
    }


@cache
def report_arrays() -> dict[str, np.ndarray]:
    names = [image["name"] for image in solution()["images"] if image["registered"]]
    m, rng = len(names), np.random.default_rng(0)
    shapes = {
        "rms_px": (2, m), "depth": (m,), "row_rms_px": (2, 32), "row_mean_px": (2, m, 12, 2),
        "cell_mean_px": (2, 1, 9, 12, 2), "histogram_px": (61,), "points_w": (40, 3), "global_points_w": (40, 3),
        "global_center_w": (m, 3),
    }  # fmt: skip
    return {
        "format": np.array("rsundistort-report"), "version": np.array(1), "names": np.array(names),
        "camera_ids": np.array(["1"]), "photos": np.array("photos"), "histogram": np.ones((2, 60), np.int64),
        "point_idx": np.arange(40), "rgb": np.zeros((40, 3), np.uint8), "global_R_cw": np.tile(np.eye(3), (m, 1, 1)),
        **{name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()},
    }  # fmt: skip


def packed(arrays: dict[str, np.ndarray], compressed: bool = True) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


ODD_ARRAYS = st.sampled_from([
    np.array(1.0), np.array(1j), np.array([True]), np.array(["x"]), np.zeros(0), np.zeros((0, 3)), np.zeros((3, 0, 2)),
    np.full((2, 2), np.nan), np.array([np.inf]), np.zeros((1, 1, 1, 1, 1)), np.zeros(3, [("a", "f8")]),
    np.array("2020-01-01", "M8[s]"), np.zeros(2, np.float16), np.asfortranarray(np.eye(3)), np.array([b"x"]),
    np.full(3, 1e300), np.array(2**63, np.uint64), np.zeros((40_000, 3)), np.array("x" * 10_000), np.array("../.."),
])  # fmt: skip


def archives(arrays: dict[str, np.ndarray]) -> st.SearchStrategy[bytes]:
    """Of damaged bytes, or of some arrays in place of others."""
    odd = st.dictionaries(st.sampled_from(sorted(arrays)), ODD_ARRAYS, min_size=1, max_size=2)
    dropped = st.sampled_from(sorted(arrays)).map(lambda name: packed({k: v for k, v in arrays.items() if k != name}))
    return st.one_of(
        odd.map(lambda changed: packed({**arrays, **changed})),
        dropped,
        damage.binaries(packed(arrays), damage.zip_marks),
        damage.binaries(packed(arrays, compressed=False), damage.zip_marks),
    )


def claimed(shape: str, descr: str = "<f8") -> bytes:
    """An .npy file that holds nothing of what it claims."""
    head = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(64)


CLAIMS = st.sampled_from([
    claimed("(1000000000,)"), claimed("(2**62,)"), claimed("(99999999999, 99999999999)"), claimed("(-1,)"),
    claimed("(1,)", "|O"), claimed("(8,)", "<c16"), claimed("(3,)", "V0"), claimed("()"), claimed("'x'"),
    claimed("(" * 500), claimed("(1.5,)"), claimed("(10**1000,)"), claimed("(2, 4)", "<U0"),
    claimed("(1,)", "<U99999999"),
])  # fmt: skip


# ---------------------------------------------------------------- cameras

YAML = b"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_name: left
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]
distortion_coefficients: &d !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, -0.02, 0.001, 0., 0.03 ]
"""
ROS = b"""image_width: 640
image_height: 480
camera_name: cam
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, 0, 0, 0, 0]
binning_x: 1
roi: {x_offset: 0, y_offset: 0, height: 480, width: 640, do_rectify: false}
"""
XML = b"""<?xml version="1.0"?>
<opencv_storage>
<image_Width>640</image_Width><image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>500. 0. 320. 0. 500. 240. 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>0.1 0. 0. 0. 0.</data></Distortion_Coefficients>
</opencv_storage>
"""
K = [[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]
CAMERA = {"width": 640, "height": 480, "K": K, "dist": [0.1, 0, 0, 0], "readout": "top-to-bottom", "sigma": {"f": 2.0}}
CAMERAS = {"cameras": {"1": CAMERA, "2": {**CAMERA, "lens": "fisheye"}}, "images": {"a.jpg": "1", "b.jpg": "2"}}
CALIBRATION = {"camera_matrix": K, "dist_coeffs": [[0.1, 0, 0, 0, 0]], "image_width": 640, "image_height": 480}


def aliases(counts: list[int]) -> bytes:
    """Lists of aliases of the list before."""
    lines = ["a0: &a0 [1, 1]"]
    lines += [f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * n)}]" for k, n in enumerate(counts)]
    return "\n".join([*lines, ROS.decode()]).encode()


@cache
def colmap_files() -> dict[str, Files]:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 4, 25
    found = {}
    with TemporaryDirectory() as folder:
        model = pycolmap.synthesize_dataset(options)
        for kind, write in (("bin", model.write_binary), ("txt", model.write_text)):
            write(folder)
            found[kind] = {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.suffix == f".{kind}"}
    return found


def camera_files() -> st.SearchStrategy[Files]:
    cameras = colmap_files()
    return one_of(
        camera__json=damage.json_texts(CAMERA),
        cameras__json=damage.json_texts(CAMERAS),
        calibration__json=damage.json_texts(CALIBRATION),
        opencv__yaml=damage.tokens(YAML),
        ros__yaml=damage.tokens(ROS),
        aliases__yaml=st.lists(st.integers(0, 12), min_size=1, max_size=12).map(aliases),
        opencv__xml=damage.tokens(XML),
        k__txt=damage.tokens(b"500 0 320\n0 500 240\n0 0 1\n"),
        cameras__txt=damage.tokens(cameras["txt"]["cameras.txt"]),
        cameras__bin=damage.binaries(cameras["bin"]["cameras.bin"]),
    )


# ---------------------------------------------------------------- models


def colmap_models() -> st.SearchStrategy[Files]:
    """A model of which one file is damaged."""
    every = colmap_files()

    def damaged(kind: str, name: str) -> st.SearchStrategy[Files]:
        data = every[kind][name]
        made = damage.binaries(data, counts_of_colmap) if kind == "bin" else damage.tokens(data)
        return made.map(lambda changed: {**every[kind], name: changed})

    return st.one_of(*(damaged(kind, name) for kind, files in every.items() for name in files))


def counts_of_colmap(data: bytes) -> list[int]:
    """Where small numbers of eight bytes stand: counts, mostly."""
    found = [k for k in range(0, len(data) - 8) if data[k] and data[k + 1 : k + 8] == bytes(7)]
    return [max(0, k - step) for k in found for step in (0, 4, 8)]


@cache
def models() -> dict[str, object]:
    truth = Truth([0.1, 0, 0, 0], num=3, points=8)
    camera = {"projection_type": "brown", "width": 640, "height": 480, "focal_x": 0.78, "focal_y": 0.78, "c_x": 0.0,
              "c_y": 0.0, "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}  # fmt: skip
    reconstruction, tracks = opensfm(truth, camera)
    return {"openmvg": openmvg(truth, {"disto_k1": [0.1]}), "opensfm": reconstruction, "tracks": tracks}


def json_models() -> st.SearchStrategy[Files]:
    made = models()
    tracks, whole = made["tracks"].encode(), made["opensfm"]
    return st.one_of(
        one_of(sfm_data__json=damage.json_texts(made["openmvg"])),
        damage.json_texts(whole).map(lambda data: {"reconstruction.json": data, "tracks.csv": tracks}),
        damage.tokens(tracks).map(lambda data: {"reconstruction.json": dumped(whole), "tracks.csv": data}),
    )


TRANSFORMS = {"frames": [{"file_path": f"{k}.jpg", "transform_matrix": np.eye(4).tolist()} for k in range(3)]}


# ---------------------------------------------------------------- tables and logs

MOTION = {
    "a.jpg": [0.01, 0.0, 0.0],
    "b.jpg": {"row": [0, 160, 320, 479], "rotation": [[0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.02, 0, 0]]},
}
MOTION_CSV = b"name,row,rx,ry,rz\na.jpg,0,0,0,0\na.jpg,160,0.01,0,0\na.jpg,320,0.02,0,0\na.jpg,479,0.02,0,0\n"
PHI = b"name,phi1,phi2,phi3,sigma\na.jpg,0.01,0,0,0.001\nb.jpg,0.01,,0,0.001\n"
OMEGA = b"name,omega1,omega2,omega3,sigma1,sigma2,sigma3\na.jpg,0.01,0,0,0.001,0.001,0.001\n"
LENGTHS = b"photo1,x1,y1,photo2,x2,y2,length,sigma\na.jpg,1,2,b.jpg,3,4,2.5,0.01\na.jpg,1,2,,30,40,1.5,0.01\n"
TIMES = b"name,time_s,frame\na.jpg,0.1,3\nb.jpg,,4\nc.jpg,0.3,5\n"
GYRO = b"time_s,wx,wy,wz\n" + b"".join(b"%.3f,0.01,-0.02,0.03\n" % (k / 200) for k in range(40))
JOURNAL = b"".join(
    dumped({"name": f"{k}.jpg", "fingerprint": "ab" * 8, "files": {f"images/{k}.jpg": 100}, "turn": 1, "depth": None})
    + b"\n"
    for k in range(3)
)
RECORD = b'["images/0.jpg", "100 5"]\n["images/1.jpg", ""]\n["images/1.jpg", null]\n'


# ---------------------------------------------------------------- photos

XMP = (
    b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    b'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    b'xmlns:tiff="http://ns.adobe.com/tiff/1.0/" xmlns:exif="http://ns.adobe.com/exif/1.0/" '
    b'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" tiff:Orientation="6" drone-dji:DewarpData="1,2,3" '
    b'drone-dji:GpsLatitude="47.5" drone-dji:GpsLongitude="8.25" drone-dji:AbsoluteAltitude="+412.3" '
    b'drone-dji:RtkStdLon="0.01" drone-dji:RtkStdLat="0.01" drone-dji:RtkStdHgt="0.02" drone-dji:GimbalYawDegree="9.5" '
    b'drone-dji:GimbalPitchDegree="-90" drone-dji:GimbalRollDegree="0" drone-dji:FlightXSpeed="1.5" '
    b'drone-dji:FlightYSpeed="0" drone-dji:FlightZSpeed="0">'
    b"<exif:PixelXDimension>64</exif:PixelXDimension><exif:PixelYDimension>48</exif:PixelYDimension>"
    b"</rdf:Description></rdf:RDF></x:xmpmeta>"
)


@cache
def whole_photos() -> Files:
    from rsundistort.io.photos.images import write_image
    from rsundistort.io.photos.metadata import Metadata

    metadata = Metadata(bytes(exif_block(6, 28)), XMP, bytes(16) + b"RGB " + bytes(180))
    found = {}
    with TemporaryDirectory() as folder:
        for suffix, dtype in ((".jpg", "uint8"), (".png", "uint8"), (".tif", "uint16"), (".webp", "uint8")):
            path = Path(folder, f"a{suffix}")
            pixels = texture(64, 48)
            write_image(path, pixels.astype(dtype) * (257 if dtype == "uint16" else 1), metadata)
            found[path.name] = path.read_bytes()
    found["b.tif"] = bytes(cv2.imencode(".tif", texture(64, 48), [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1])
    found["c.tif"] = tiff_file(texture(64, 48).astype("i2"), 2, planar=True, method="lzw", predictor=2, tile=32)
    found["c.jpg"] = bytes(cv2.imencode(".jpg", texture(64, 48), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
    return found


MARKS = {
    "jpg": (damage.jpeg_marks, None), "png": (damage.png_marks, damage.png_mended),
    "tif": (damage.tiff_marks, None), "webp": (damage.riff_marks, None),
}  # fmt: skip


def photos() -> st.SearchStrategy[Files]:
    files = whole_photos()
    made = {name: damage.binaries(data, *MARKS[name.rpartition(".")[2]]) for name, data in files.items()}
    named = {name.replace(".", "__"): each for name, each in made.items()}
    # under the names of other kinds
    return st.one_of(one_of(**named), one_of(x__dng=made["a.tif"], x__png=made["a.jpg"], x__heic=made["a.webp"]))


def masks() -> st.SearchStrategy[Files]:
    mask = np.full((48, 64), 255, np.uint8)
    png, tif = (bytes(cv2.imencode(suffix, mask)[1]) for suffix in (".png", ".tif"))
    return one_of(
        m__png=damage.binaries(png, damage.png_marks, damage.png_mended), m__tif=damage.binaries(tif, damage.tiff_marks)
    )


def depths() -> st.SearchStrategy[Files]:
    array = np.ones((48, 64), np.float32)
    tif = bytes(cv2.imencode(".tif", array)[1])
    return one_of(
        d__npy=damage.binaries(npy(array)) | CLAIMS | ODD_ARRAYS.map(npy),
        d__npz=archives({"depth": array}),
        d__tif=damage.binaries(tif, damage.tiff_marks),
    )


# ---------------------------------------------------------------- videos


@cache
def video(frames: int = 6) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder, "v.mp4")
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for k in range(frames):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(texture(64, 48, k), format="bgr24")))
            container.mux(stream.encode(None))
        return path.read_bytes()


@cache
def video_with_telemetry() -> bytes:
    with TemporaryDirectory() as folder:
        return mux(Path(folder, "v.mp4"), telemetry([40] * 3), frames=3).read_bytes()


@cache
def recipe() -> dict:
    return json.loads((SEEDS / "recipe.json").read_text())


def reports() -> st.SearchStrategy[Files]:
    whole = packed(report_arrays())
    return st.one_of(
        damage.json_texts(solution()).map(lambda data: {"solution.json": data, "report.npz": whole}),
        archives(report_arrays()).map(lambda data: {"solution.json": dumped(solution()), "report.npz": data}),
    )


@cache
def wholes() -> dict[str, list[Files]]:
    """Files as they should be, of each group: what is damaged here is read before."""
    made, photos = models(), whole_photos()
    tracks = {"tracks.csv": made["tracks"].encode(), "reconstruction.json": dumped(made["opensfm"])}
    mask, depth = np.full((48, 64), 255, np.uint8), np.ones((48, 64), np.float32)
    models_of_colmap = colmap_files()
    each: dict[str, Files] = {
        "solutions": {"s.json": dumped(solution())},
        "rectifying": {"solution.json": dumped(small_solution())},
        "cameras": {
            "camera.json": dumped(CAMERA), "cameras.json": dumped(CAMERAS), "calibration.json": dumped(CALIBRATION),
            "opencv.yaml": YAML, "ros.yaml": ROS, "opencv.xml": XML,
            "cameras.bin": models_of_colmap["bin"]["cameras.bin"],
            "cameras.txt": models_of_colmap["txt"]["cameras.txt"],
        },
        "recipes": {"r.json": dumped(recipe())},
        "transforms": {"t.json": dumped(TRANSFORMS)},
        "motions": {"m.json": dumped(MOTION), "m.csv": MOTION_CSV},
        "known motions": {"a.csv": PHI, "b.csv": OMEGA},
        "lengths": {"l.csv": LENGTHS},
        "times": {"t.csv": TIMES},
        "gyroscopes": {"g.csv": GYRO, "g.gcsv": GCSV.format(orientation="XYZ").encode()},
        "telemetry": {"v.mp4": video_with_telemetry()},
        "videos": {"v.mp4": video()},
        "photos": photos,
        "masks": {"m.png": encoded(".png", mask)},
        "depth maps": {"d.npy": npy(depth), "d.npz": packed({"depth": depth}), "d.tif": encoded(".tif", depth)},
        "diagnostics": {"r.npz": packed(report_arrays())},
        "grids": {"g.npz": packed(GRID)},
        "XMP": {"x.xmp": XMP},
        "journals": {"j.jsonl": JOURNAL, "r.jsonl": RECORD},
    }  # fmt: skip
    together = {
        "reports": [{"solution.json": dumped(solution()), "report.npz": packed(report_arrays())}],
        "models as JSON": [{"sfm_data.json": dumped(made["openmvg"])}, tracks],
        "models of COLMAP": list(models_of_colmap.values()),
    }
    return {name: [{path: data} for path, data in files.items()] for name, files in each.items()} | together


GRID = {"map_x": np.eye(9, dtype="f4"), "map_y": np.eye(9, dtype="f4"), "source_size": np.array([9, 9])}

GROUPS: dict[str, Group] = {
    "solutions": Group("solution", lambda: one_of(s__json=damage.json_texts(solution())), 1500),
    "reports": Group("report", reports, 150),
    "rectifying": Group(
        "rectify", lambda: one_of(solution__json=damage.json_texts(small_solution())), 300, small_photos
    ),
    "cameras": Group("camera", camera_files, 1500),
    "recipes": Group("recipe", lambda: one_of(r__json=damage.json_texts(recipe())), 700),
    "models as JSON": Group("model", json_models, 700),
    "models of COLMAP": Group("colmap", colmap_models, 900),
    "transforms": Group("transforms", lambda: one_of(t__json=damage.json_texts(TRANSFORMS)), 200),
    "motions": Group(
        "motion", lambda: one_of(m__json=damage.json_texts(MOTION), m__csv=damage.tokens(MOTION_CSV)), 200
    ),
    "known motions": Group(
        "known motions", lambda: one_of(a__csv=damage.tokens(PHI), b__csv=damage.tokens(OMEGA)), 200
    ),
    "lengths": Group("lengths", lambda: one_of(l__csv=damage.tokens(LENGTHS)), 150),
    "times": Group("times", lambda: one_of(t__csv=damage.tokens(TIMES)), 100),
    "gyroscopes": Group(
        "gyroscope",
        lambda: one_of(g__csv=damage.tokens(GYRO), g__gcsv=damage.tokens(GCSV.format(orientation="XYZ").encode())),
        200,
    ),
    "GPMF": Group(
        "gpmf", lambda: one_of(p__bin=damage.binaries(payload(gyro(COUNTS, total=403)), damage.klv_marks)), 200
    ),
    "telemetry": Group(
        "telemetry", lambda: one_of(v__mp4=damage.binaries(video_with_telemetry(), damage.box_marks)), 300
    ),
    "videos": Group("video", lambda: one_of(v__mp4=damage.binaries(video(), damage.box_marks)), 250),
    "photos": Group("photo", photos, 1400),
    "masks": Group("mask", masks, 150),
    "depth maps": Group("depth", depths, 250),
    "diagnostics": Group("diagnostics", lambda: one_of(r__npz=archives(report_arrays())), 150),
    "grids": Group(
        "grid",
        lambda: one_of(g__npz=archives(GRID)),
        150,
    ),
    "XMP": Group("xmp", lambda: one_of(x__xmp=damage.tokens(XMP)), 300),
    "journals": Group("record", lambda: one_of(j__jsonl=damage.tokens(JOURNAL), r__jsonl=damage.tokens(RECORD)), 150),
}
