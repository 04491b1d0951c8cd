"""What is written for other programs, read back by their own libraries, or by their formulas."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    Observations,
    Reconstruction,
    RectifyOptions,
    RowMotion,
    Solution,
    SolvedImage,
    SolveOptions,
    solve,
)
from rsundistort.batch.progress import StageLog
from rsundistort.colmap.rectified_model import ModelIds
from rsundistort.errors import FormatError, InputError, MissingOutputWarning
from rsundistort.io.export_scene import ExportScene
from rsundistort.io.exports import EXPORTS, check_exports
from rsundistort.io.metashape import read_metashape
from rsundistort.io.models import read_model
from rsundistort.io.shutter_poses import write_shutter_poses
from rsundistort.model.projection import project_points, unproject_points
from rsundistort.model.track import CameraTrack
from rsundistort.solve import OutputOptions
from rsundistort.solve.run_outputs import Outputs

W, H = 640, 480


def made(model: str = "constant-motion", readout: str = "top-to-bottom", f: tuple[float, float] = (500, 500)):
    """A scene of five photos whose cameras rotate and travel, and where each shows thirty points."""
    rng = np.random.default_rng(8)
    raw = Camera(W, H, [[505, 0, 322.0], [0, 505, 236.5], [0, 0, 1]], [-0.1, 0.02, 1e-3, -2e-3, 0.01], readout)
    new = Camera(W, H, [[f[0], 0, 330.0], [0, f[1], 231.25], [0, 0, 1]])
    names = [f"{'walk/' * (k == 2)}{k}.jpg" for k in range(5)]
    R_cw = Rotation.from_rotvec(rng.normal(0, 0.2, (5, 3))).as_matrix()
    center_w = rng.normal(0, 1, (5, 3))
    phi, velocity = rng.normal(0, 0.03, (5, 3)), rng.normal(0, 0.1, (5, 3))
    points_w = np.column_stack([rng.uniform(-2, 2, (30, 2)), rng.uniform(7, 12, 30)])
    frame, point, xy = [], [], []
    for k in range(5):
        motion = RowMotion(phi[k], velocity[k]).in_camera(R_cw[k])
        seen, valid = project_points((points_w - center_w[k]) @ R_cw[k].T, raw, motion, model)
        frame += [k] * int(valid.sum())
        point += np.flatnonzero(valid).tolist()
        xy += seen[valid].tolist()
    obs = Observations(np.array(frame), np.array(point), np.array(xy))
    rec = Reconstruction([raw], names, np.zeros(5, int), R_cw, center_w, points_w, obs, phi, velocity, model)
    images = tuple(
        SolvedImage(name, "1", R_cw[k], center_w[k], RowMotion(phi[k], velocity[k])) for k, name in enumerate(names)
    )
    solution = Solution(model, {"1": raw}, {"1": new}, images)
    rgb = rng.integers(0, 256, (30, 3)).astype(np.uint8)
    return ExportScene(solution, rec, {name: name for name in names}, rgb, solution)


def shown(scene: ExportScene, k: int, points_w: np.ndarray) -> np.ndarray:
    """Where the rectified photo k shows points, integer centres."""
    x_c = (points_w - scene.images[k].center_w) @ scene.images[k].R_cw.T
    return (x_c / x_c[:, 2:]) @ scene.camera(scene.images[k]).K[:2].T


def check_poses(scene: ExportScene, names, R_cw, center_w) -> None:
    for name, R, center in zip(names, R_cw, center_w, strict=True):
        image = next(each for each in scene.images if Path(each.name).name == Path(name).name)
        np.testing.assert_allclose(R, image.R_cw, atol=1e-9)
        np.testing.assert_allclose(center, image.center_w, atol=1e-9)


# ---------------------------------------------------------------- OpenSfM


def test_an_opensfm_project_is_read_back_with_all_it_carries(tmp_path):
    scene = made(f=(500, 498))
    assert EXPORTS["opensfm"].write(tmp_path / "opensfm", scene) == ""
    rec = read_model(tmp_path / "opensfm" / "reconstruction.json").reconstruction
    check_poses(scene, rec.image_names, rec.R_cw, rec.center_w)
    np.testing.assert_allclose(rec.cameras[0].K, scene.camera(scene.images[0]).K, atol=1e-9)
    assert not rec.cameras[0].dist.any()
    for k, name in enumerate(rec.image_names):
        mine = rec.observations.frame_idx == k
        i = [Path(image.name).name for image in scene.images].index(name)
        expected = shown(scene, i, rec.points_w[rec.observations.point_idx[mine]])
        np.testing.assert_allclose(rec.observations.xy_raw[mine], expected, atol=1e-6)
    lines = (tmp_path / "opensfm" / "image_list.txt").read_text().splitlines()
    assert "../images/walk/2.jpg" in lines


def test_opensfm_gets_a_perspective_camera_where_that_says_all(tmp_path):
    scene = made()
    middle = Camera(W, H, [[500, 0, (W - 1) / 2], [0, 500, (H - 1) / 2], [0, 0, 1]])
    scene = replace(scene, solution=replace(scene.solution, rectified_cameras={"1": middle}))
    EXPORTS["opensfm"].write(tmp_path, scene)
    (camera,) = json.loads((tmp_path / "camera_models.json").read_text()).values()
    assert (camera["projection_type"], camera["focal"]) == ("perspective", 500 / 640)


def test_photos_that_opensfm_would_take_for_one_are_refused_before_any_work():
    with pytest.raises(InputError, match=r"which a/0\.jpg and b/0\.jpg share"):
        check_exports(["opensfm"], ["a/0.jpg", "b/0.jpg"])


def on_the_map(scene: ExportScene, folder: Path, crs: str, origin) -> ExportScene:
    """The scene in a frame of the map, and its first photo with GPS known to 2 m across."""
    from PIL import Image

    exif = Image.Exif()
    place = {1: "N", 2: (46.0, 30.0, 0.0), 3: "W", 4: (7.0, 15.0, 0.0), 5: b"\0", 6: 431.5, 31: 2.0 * 1.5096}
    exif.get_ifd(0x8825).update(place)
    Image.new("RGB", (8, 8)).save(folder / "0.jpg", exif=exif)
    matrix = np.eye(4)
    matrix[:3, 3] = origin  # of a projection; "local" has its axes there, too
    stated = {"crs": crs, "origin": list(origin), "transformation": matrix.tolist()}
    there = replace(scene.solution, georeference=stated)
    return replace(scene, source=folder, solution=there, stored=there)


def test_opensfm_gets_the_gps_of_the_photos_and_where_the_frame_is(tmp_path):
    scene = on_the_map(made(), tmp_path, "local", (46.5, -7.25, 400.0))
    EXPORTS["opensfm"].write(tmp_path / "out", scene)
    stated = json.loads((tmp_path / "out" / "exif" / "0.jpg.exif").read_text())
    assert stated["gps"] == pytest.approx(
        {"latitude": 46.5, "longitude": -7.25, "altitude": 431.5, "dop": 2.0}, abs=1e-3
    )
    assert json.loads((tmp_path / "out" / "exif" / "1.jpg.exif").read_text())["gps"] == {}
    (found,) = json.loads((tmp_path / "out" / "reconstruction.json").read_text())
    assert found["reference_lla"] == {"latitude": 46.5, "longitude": -7.25, "altitude": 400.0}
    assert found["shots"]["0.jpg"]["gps_position"] == pytest.approx([0.0, 0.0, 31.5], abs=1e-6)
    assert json.loads((tmp_path / "out" / "reference_lla.json").read_text()) == found["reference_lla"]


# ---------------------------------------------------------------- Metashape


def test_metashape_is_read_back_to_the_last_digit(tmp_path):
    scene = made(f=(500, 498))
    assert EXPORTS["metashape"].write(tmp_path, scene) == ""
    found = read_metashape(tmp_path / "cameras.xml")
    assert found.labels == ("0", "1", "2", "3", "4")
    check_poses(scene, [f"{label}.jpg" for label in found.labels], found.R_cw, found.center_w)
    np.testing.assert_allclose(found.cameras[0].K, scene.camera(scene.images[0]).K, atol=1e-9)


# ---------------------------------------------------------------- OPF


@pytest.mark.parametrize("name", ["opf", "opf-rectified"])
def test_opf_is_what_its_own_library_takes_and_read_back(tmp_path, name):
    pytest.importorskip("pyopf")
    from pyopf.io import load
    from pyopf.resolve import resolve

    scene = made()
    said = EXPORTS[name].write(tmp_path / "opf", scene)
    project = resolve(load(str(tmp_path / "opf" / "project.opf")))
    assert len(project.calibration_objs[0].calibrated_cameras.cameras) == 5
    rec = read_model(tmp_path / "opf" / "project.opf").reconstruction
    assert len(rec.observations) == len(scene.reconstruction.observations)
    if name == "opf-rectified":
        assert said == ""
        check_poses(scene, rec.image_names, rec.R_cw, rec.center_w)
        np.testing.assert_allclose(rec.cameras[0].K, scene.camera(scene.images[0]).K, atol=1e-9)
    else:
        assert re.search(r"the worst pixel is off by \d+ px; opf-rectified is exact", said)
        raw = scene.solution.cameras["1"]
        np.testing.assert_allclose(rec.cameras[0].K, raw.K, atol=1e-9)
        np.testing.assert_allclose(rec.cameras[0].dist, raw.dist, atol=1e-12)
    np.testing.assert_allclose(rec.points_w, scene.reconstruction.points_w, atol=1e-5)  # float32 in glTF
    for k in range(5):
        x_c = (rec.points_w - rec.center_w[k]) @ rec.R_cw[k].T
        mine = rec.observations.frame_idx == k
        if name == "opf-rectified":
            expected = (x_c / x_c[:, 2:])[rec.observations.point_idx[mine]] @ rec.cameras[0].K[:2].T
            np.testing.assert_allclose(rec.observations.xy_raw[mine], expected, atol=2e-3)


def test_pix4ds_own_converter_makes_the_same_colmap_model_of_opf(tmp_path, monkeypatch):
    pytest.importorskip("pyopf")
    from opf_tools.opf2colmap.converter import main

    scene = made()
    EXPORTS["opf-rectified"].write(tmp_path / "opf", scene)
    asked = ["opf2colmap", str(tmp_path / "opf" / "project.opf"), "--out-dir", str(tmp_path / "colmap")]
    monkeypatch.setattr("sys.argv", asked)
    main()
    rec = read_model(tmp_path / "colmap").reconstruction
    check_poses(scene, rec.image_names, rec.R_cw, rec.center_w)
    np.testing.assert_allclose(rec.cameras[0].K, scene.camera(scene.images[0]).K, atol=1e-9)
    for k, name in enumerate(rec.image_names):
        mine = rec.observations.frame_idx == k
        i = [Path(image.name).name for image in scene.images].index(Path(name).name)
        expected = shown(scene, i, rec.points_w[rec.observations.point_idx[mine]])
        np.testing.assert_allclose(rec.observations.xy_raw[mine], expected, atol=2e-3)  # float32
    assert len(rec.observations) == len(scene.reconstruction.observations)


def test_opf_gets_the_gps_of_the_photos_and_the_projection(tmp_path):
    pytest.importorskip("pyopf")
    from pyopf.io import load
    from pyopf.resolve import resolve

    scene = on_the_map(made(), tmp_path, "EPSG:32629", (457000.0, 5150000.0, 0.0))
    EXPORTS["opf-rectified"].write(tmp_path / "opf", scene)
    project = resolve(load(str(tmp_path / "opf" / "project.opf")))
    first, second = project.input_cameras.captures[:2]
    np.testing.assert_allclose(first.geolocation.coordinates, [46.5, -7.25, 431.5])
    np.testing.assert_allclose(first.geolocation.sigmas[:2], 2.0, rtol=1e-3)
    assert first.geolocation.crs.definition == "EPSG:4326+5773"
    assert second.geolocation is None
    frame = project.scene_reference_frame
    assert frame.crs.definition == "EPSG:32629"
    stated = read_model(tmp_path / "opf" / "project.opf").georeference
    assert (stated["crs"], stated["origin"]) == ("EPSG:32629", [457000.0, 5150000.0, 0.0])
    # from E, N, U to the coordinates of the poses
    np.testing.assert_array_equal(
        frame.base_to_canonical.transformation_matrix @ [457001.0, 5150002.0, 3.0, 1.0], [1.0, 2.0, 3.0, 1.0]
    )


def test_a_projection_of_opf_goes_through_solve(tmp_path):
    """Axes scaled and exchanged, and a constant geoid, as Pix4D may have them."""
    pytest.importorskip("pyopf")
    from pyopf.io import load

    EXPORTS["opf-rectified"].write(tmp_path / "in", on_the_map(made(), tmp_path, "EPSG:32629", (457000.0, 5e6, 0.0)))
    path = tmp_path / "in" / "scene_reference_frame.json"
    stated = json.loads(path.read_text())
    stated["base_to_canonical"] = {"scale": [0.5, 0.5, 1.0], "shift": [-7.0, 9.0, 2.0], "swap_xy": True}
    stated["crs"] = {"definition": "EPSG:32629+5773", "geoid_height": 51.5}
    path.write_text(json.dumps(stated))
    options, outputs = (
        SolveOptions(shutter_model="global", readout="top-to-bottom"),
        OutputOptions(exports=("opf-rectified",)),
    )
    solution = solve(tmp_path / "in" / "project.opf", tmp_path / "out", options, outputs=outputs)
    matrix = np.array(solution.georeference["transformation"])
    np.testing.assert_allclose(matrix @ [1.0, 2.0, 3.0, 1.0], [-14.0, 16.0, 1.0, 1.0], atol=1e-12)
    before, after = (load(str(tmp_path / at)) for at in (path, "out/opf-rectified/scene_reference_frame.json"))
    assert after.crs == before.crs
    for key in ("scale", "shift", "swap_xy"):
        np.testing.assert_array_equal(getattr(after.base_to_canonical, key), getattr(before.base_to_canonical, key))
    assert "EPSG:32629+5773" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["opf-rectified", "nuke"])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_a_pose_whose_angles_fall_together_is_kept(tmp_path, name, axis, off):
    """Straight down, or to the side: the middle angle is 90 degrees."""
    if EXPORTS[name].module:
        pytest.importorskip(EXPORTS[name].module)
    scene = made()
    R = Rotation.from_rotvec(np.eye(3)[axis] * (np.pi / 2 - off)).as_matrix()
    images = [replace(image, R_cw=R if k % 2 else R.T) for k, image in enumerate(scene.solution.images)]
    scene = replace(scene, solution=replace(scene.solution, images=tuple(images)))
    EXPORTS[name].write(tmp_path, scene)
    if name == "nuke":
        turns = np.radians(np.loadtxt(tmp_path / "camera.chan")[:, 4:7]).T
        by_x, by_y, by_z = (Rotation.from_rotvec(np.outer(turns[k], np.eye(3)[k])) for k in range(3))
        turned = (by_y * by_x * by_z).as_matrix()
        flip = np.diag([1, -1, -1])
        found = (flip @ turned @ flip).transpose(0, 2, 1)
    else:
        found = read_model(tmp_path / "project.opf").reconstruction.R_cw
    images = sorted(images, key=lambda image: image.name) if name == "nuke" else images
    np.testing.assert_allclose(found, [image.R_cw for image in images], atol=1e-9)


@pytest.mark.parametrize("name", ["metashape", "nuke", "opensfm", "opf", "opf-rectified"])
def test_the_same_scene_is_written_the_same(tmp_path, name):
    if EXPORTS[name].module:
        pytest.importorskip(EXPORTS[name].module)
    for place in ("a", "b"):
        EXPORTS[name].write(tmp_path / place, made())
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) >= len(EXPORTS[name].files)
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("readout", ["top-to-bottom", "bottom-to-top"])
def test_opf_of_a_camera_that_only_travels_is_exact_and_read_back(tmp_path, readout):
    """By the formula of the paper: at the row v the camera is at `position + (v/(H-1) - 1/2) rolling_shutter`."""
    pytest.importorskip("pyopf")
    from pyopf.io import load

    scene = made(readout=readout)
    still = [replace(image, motion=RowMotion(np.zeros(3), image.motion.velocity)) for image in scene.solution.images]
    stored = replace(scene.solution, images=tuple(still))
    assert EXPORTS["opf"].write(tmp_path, replace(scene, stored=stored)) == ""
    cameras = load(str(tmp_path / "calibration" / "calibrated_cameras.json")).cameras
    raw, point = stored.cameras["1"], np.array([[0.4, -0.3, 9.0]])
    for image, camera in zip(stored.images, cameras, strict=True):
        motion = image.motion.in_camera(image.R_cw)
        xy, _ = project_points((point - image.center_w) @ image.R_cw.T, raw, motion, "constant-motion")
        R_wc = Rotation.from_euler("XYZ", camera.orientation_deg, degrees=True).as_matrix() @ np.diag([1, -1, -1])
        at = camera.position + (xy[0, 1] / (H - 1) - 0.5) * camera.rolling_shutter
        again, _ = project_points((point - at) @ R_wc, raw, None, "global")
        np.testing.assert_allclose(again, xy, atol=1e-6)
    rec = read_model(tmp_path / "project.opf").reconstruction
    check_poses(scene, rec.image_names, rec.R_cw, rec.center_w)
    assert rec.shutter_model == "constant-motion"
    # what is read downwards there travels the other way
    velocity = np.array([image.motion.velocity for image in still]) * raw.clock_sign
    np.testing.assert_allclose(rec.velocity, velocity, atol=1e-9)


def test_opf_has_no_room_for_columns_read_one_after_the_other(tmp_path):
    pytest.importorskip("pyopf")
    with pytest.raises(InputError, match="these are by column; take opf-rectified"):
        EXPORTS["opf"].write(tmp_path, made(readout="left-to-right"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "project.opf").write_text("{"), "is no OPF project"),
        (lambda folder: (folder / "project.opf").write_text("[1]"), "is no OPF project"),
        (lambda folder: (folder / "calibration" / "calibrated_cameras.json").unlink(), "is no OPF project"),
        (lambda folder: (folder / "calibration" / "matchPixelCoordinates.bin").write_bytes(b""), "is no OPF project"),
        (lambda folder: _replace(folder / "input_cameras.json", '"id": 1', '"id": 9'), "is no OPF project"),
        (lambda folder: _replace(folder / "camera_list.json", "0.jpg", "../../x.jpg"), "inside the folder of photos"),
        (
            lambda folder: _replace(folder / "calibration" / "calibrated_cameras.json", "perspective", "spherical"),
            "is spherical, expected perspective",
        ),
    ],
)
def test_a_damaged_opf_project_is_one_line(tmp_path, damage, message):
    pytest.importorskip("pyopf")
    EXPORTS["opf-rectified"].write(tmp_path, made())
    damage(tmp_path)
    with pytest.raises(FormatError, match=message) as caught:
        read_model(tmp_path / "project.opf")
    assert len(str(caught.value).splitlines()) == 1


def _replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


# ---------------------------------------------------------------- NCore


@pytest.mark.parametrize("readout", ["top-to-bottom", "right-to-left"])
def test_ncore_is_read_by_its_own_reader_with_a_pose_at_both_ends(tmp_path, readout):
    pytest.importorskip("ncore", reason="brings torch and CUDA, 3 GB")
    from ncore.data.v4 import (
        CameraSensorComponent,
        IntrinsicsComponent,
        PosesComponent,
        SequenceComponentGroupsReader,
    )
    from upath import UPath

    scene = made(readout=readout)
    for image in scene.images:
        (tmp_path / image.name).parent.mkdir(exist_ok=True)
        (tmp_path / image.name).write_bytes(b"\xff\xd8 " + image.name.encode())
    with pytest.raises(InputError, match="say where they are"):
        EXPORTS["ncore"].write(tmp_path / "ncore", scene)
    assert EXPORTS["ncore"].write(tmp_path / "ncore", replace(scene, source=tmp_path)) == ""
    reader = SequenceComponentGroupsReader([UPath(path) for path in sorted((tmp_path / "ncore").glob("*.zarr"))])
    poses, times = reader.open_component_readers(PosesComponent.Reader)["default"].get_dynamic_pose("rig", "world")
    photos = reader.open_component_readers(CameraSensorComponent.Reader)["camera1"]
    lens = reader.open_component_readers(IntrinsicsComponent.Reader)["default"].get_camera_model_parameters("camera1")
    raw = scene.solution.cameras["1"]
    assert lens.shutter_type.name == f"ROLLING_{readout.upper().replace('-', '_')}"
    np.testing.assert_allclose(lens.principal_point, raw.K[:2, 2] + 0.5, atol=1e-4)
    assert photos.frames_count == 5
    images = sorted(scene.images, key=lambda image: image.name)
    for image, (start, end) in zip(images, photos.frames_timestamps_us.tolist(), strict=True):
        assert bytes(photos.get_frame_data(end).get_encoded_image_data()).endswith(image.name.encode())
        first, last = (poses[times.tolist().index(each)] for each in (start, end))
        lines = (np.array([[0.0, 0.0]]), np.array([[W - 1.0, H - 1.0]]))
        for xy, pose in zip(lines[:: int(raw.clock_sign)], (first, last), strict=True):
            axis = raw.clock_axis
            clock = (xy[0, axis] - raw.K[axis, 2]) / raw.K[axis, axis] * raw.clock_sign
            R, center = image.motion.pose_at(clock, image.R_cw, image.center_w)
            np.testing.assert_allclose(pose[:3, :3], R.T, atol=1e-9)
            np.testing.assert_allclose(pose[:3, 3], center, atol=1e-9)


# ---------------------------------------------------------------- gsplat


@pytest.mark.parametrize("readout", ["top-to-bottom", "bottom-to-top", "left-to-right"])
def test_the_loader_for_gsplat_has_the_poses_of_the_first_line_and_the_last(tmp_path, readout):
    """The block of docs/for-splats.md, of no more than 40 lines: what a line shows is seen from its pose."""
    import cv2

    page = (Path(__file__).parent.parent / "docs" / "for-splats.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, flags=re.S)[1].split("\n\ndata = ")[0]
    assert len(code.splitlines()) <= 40
    names: dict = {}
    exec(code, names)
    scene = made(readout=readout)
    write_shutter_poses(tmp_path / "rs-poses", scene.stored, {image.name: image.name for image in scene.images}, "x")
    for image in scene.images:
        (tmp_path / image.name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / image.name), np.full((H, W, 3), 7, np.uint8))
    data = names["ShutterDataset"](tmp_path, tmp_path)
    assert (len(data), len(names["ShutterDataset"](tmp_path, tmp_path, "val"))) == (4, 1)
    raw = scene.stored.cameras["1"]
    ends = np.array([[W / 2, H / 2], [W / 2, H / 2]])
    ends[:, raw.clock_axis] = [0.0, raw.num_lines - 1.0][:: int(raw.clock_sign)]
    for k in range(4):
        item, image = data[k], scene.images[k + 1]
        assert (item["image"].shape, item["image"].dtype, item["image_id"]) == ((H, W, 3), np.float32, k)
        assert item["rolling_shutter"] == f"ROLLING_{readout.upper().replace('-', '_')}"
        assert item["K"][0, 2] == pytest.approx(raw.K[0, 2] + 0.5)
        motion = image.motion.in_camera(image.R_cw)
        for xy, viewmat in zip(ends, (np.linalg.inv(item["camtoworld"]), item["viewmat_rs"]), strict=True):
            # a point on the ray of that pixel, by the pose of its line, without the shutter
            ray, _ = unproject_points(xy[None], raw, None, "global")
            point_w = (np.array([*ray[0], 1.0]) * 9 - viewmat[:3, 3]) @ viewmat[:3, :3]
            found, _ = project_points(((point_w - image.center_w) @ image.R_cw.T)[None], raw, motion, "constant-motion")
            np.testing.assert_allclose(found[0], xy, atol=2e-3)  # float32


# ---------------------------------------------------------------- Nuke


def nuke_pixels(text: str, frame: int, points: np.ndarray) -> np.ndarray:
    """Pixels from the upper left corner, by the matrices of Nuke's own `nukescripts.snap3d`."""

    def knob(name: str) -> list[float]:
        line = re.search(rf"^ {name} (.*)$", text, flags=re.M)
        values = []
        for curve, number in re.findall(r"\{curve ([^}]*)\}|(-?[\d.]+(?:e-?\d+)?)", line[1]):
            keys = dict(re.findall(r"x(-?\d+) (\S+)", curve))
            values.append(float(keys[str(frame)] if curve else number))
        return values

    rx, ry, rz = np.radians(knob("rotate"))
    R = Rotation.from_rotvec([0, ry, 0]) * Rotation.from_rotvec([rx, 0, 0]) * Rotation.from_rotvec([0, 0, rz])
    x, y, z = R.inv().apply(points - knob("translate")).T
    (u, v), (su, sv) = knob("win_translate"), knob("win_scale")
    scale = 2 * knob("focal")[0] / knob("haperture")[0]
    right, up = (scale * x / -z - u) / su, (scale * y / -z - v) / sv
    return np.column_stack([(right + 1) * W / 2, H / 2 - up * W / 2])


@pytest.mark.parametrize("clip", [False, True])
def test_nukes_camera_shows_points_where_the_frames_do(tmp_path, clip):
    scene = made(f=(500, 498))
    images = scene.images
    images = sorted(images, key=lambda image: image.name)
    frames = range(1, 6)
    if clip:
        times = np.array([0.0, 1.0, 2.0, 3.0, 5.0]) / 25
        R_cw, center_w = (np.array([getattr(image, key) for image in images]) for key in ("R_cw", "center_w"))
        scene = replace(scene, track=CameraTrack(times, 1 / 25, R_cw, center_w, scene.camera(images[0])))
        frames = (1, 2, 3, 4, 6)
    assert EXPORTS["nuke"].write(tmp_path, scene) == ""
    text = (tmp_path / "camera.nk").read_text()
    points_w = scene.reconstruction.points_w
    chan = np.loadtxt(tmp_path / "camera.chan")
    assert chan[:, 0].tolist() == list(frames)
    for k, (frame, image) in enumerate(zip(frames, images, strict=True)):
        found = nuke_pixels(text, frame, points_w * [1, -1, -1])
        x_c = (points_w - image.center_w) @ image.R_cw.T
        expected = (x_c / x_c[:, 2:]) @ scene.camera(image).K[:2].T + 0.5
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert chan[k, 7] == pytest.approx(np.degrees(2 * np.arctan(H / 2 / 498)))


# ---------------------------------------------------------------- what is asked for


def test_exports_lie_beside_the_other_outputs_and_one_that_fails_is_said(tmp_path):
    """Photos that are rotated: OPF has the original ones, which are not."""
    pytest.importorskip("pyopf")
    scene = made()
    options = OutputOptions(exports=("metashape", "nuke", "opensfm", "opf", "opf-rectified"))
    turns = dict.fromkeys(scene.names, 6)
    ids = ModelIds.in_order(scene.reconstruction)
    outputs = Outputs(scene.solution, scene.reconstruction, RectifyOptions(), options, ids, turns, with_photos=False)
    with pytest.warns(MissingOutputWarning, match="no opf was written: .*--apply-orientation"):
        turned = outputs.begin(tmp_path, StageLog(None))
    assert not (tmp_path / "opf").exists()
    for name in ("metashape", "opensfm", "opf-rectified"):
        for file in EXPORTS[name].files:
            assert (tmp_path / name / file).is_file()
    rec = read_model(tmp_path / "opf-rectified" / "project.opf").reconstruction
    assert (rec.cameras[0].width, rec.cameras[0].height) == (H, W)
    np.testing.assert_allclose(rec.R_cw[0], turned.image(rec.image_names[0]).R_cw, atol=1e-9)


def test_a_run_whose_export_could_not_be_written_ends_with_exit_code_3(tmp_path, monkeypatch):
    scene = made()

    def write(folder, _):
        folder.mkdir()
        (folder / "camera.nk").write_text("half")
        raise InputError("the frames have no order")

    def run(*_, **__):
        ids, options = ModelIds.in_order(scene.reconstruction), OutputOptions(exports=("nuke", "metashape"))
        outputs = Outputs(scene.solution, scene.reconstruction, RectifyOptions(), options, ids, {}, with_photos=False)
        return outputs.begin(tmp_path, StageLog(None))

    monkeypatch.setitem(EXPORTS, "nuke", replace(EXPORTS["nuke"], write=write))
    monkeypatch.setattr(sys.modules["rsundistort.solve"], "run", run)
    result = CliRunner().invoke(cli, ["run", str(tmp_path), "-o", str(tmp_path / "out"), "--quiet"])
    said = "no nuke was written: the frames have no order"
    assert (result.exit_code, result.stderr) == (3, f"warning: {said}\n\nfailed:\n  nuke/: {said}\n")
    assert not (tmp_path / "nuke").exists()
    assert (tmp_path / "metashape" / "cameras.xml").is_file()


def test_what_there_is_no_writer_for_is_refused():
    with pytest.raises(InputError, match="export='maya', expected one of metashape"):
        check_exports(["maya"])


def test_an_extra_that_is_missing_is_reported_before_any_work(monkeypatch):
    def without(name: str) -> None:
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr("rsundistort.io.exports.import_module", without)
    said = r"--export opf needs the extra opf: pip install \"rsundistort\[opf\]\" \(No module named 'pyopf'\)"
    with pytest.raises(InputError, match=said):
        check_exports(["opf"])
