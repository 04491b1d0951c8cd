"""What the fuzzer found, each with a name: inputs that once ended in a traceback, took all memory, or hung."""

from __future__ import annotations

import io
import json
import math
import struct
import time
import zipfile
import zlib
from functools import partial

import cv2
import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("pillow_heif")

from groups import claimed, colmap_files, npy, packed, recipe, report_arrays, solution
from other_groups import CONTROL, SETTINGS, TRIALS, altered, database, kept, lines, opf, raw_photos, scene

from rsundistort import read_solution, rectify_folder, write_solution
from rsundistort.colmap.cameras_and_poses import read_colmap_cameras, read_colmap_poses
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.experiments.one import check_settings, read_trials
from rsundistort.experiments.scenes import load_scene
from rsundistort.io import read_control_points, read_known_lengths
from rsundistort.io.cameras import read_camera_file
from rsundistort.io.depth_maps import read_depth_map
from rsundistort.io.gpmf import read_gpmf
from rsundistort.io.journal import entries_of
from rsundistort.io.kept import Kept
from rsundistort.io.masks import read_mask
from rsundistort.io.models import read_model
from rsundistort.io.photos.images import read_photo
from rsundistort.model.arrays import read_arrays
from rsundistort.rectify import RemapGrid
from rsundistort.report import write_report
from rsundistort.report.diagnostics import read_diagnostics
from rsundistort.sfm.imported import matched_of_database
from rsundistort.solve import OutputOptions
from rsundistort.synthetic.recipe import load_recipe


def changed(tree, path, value):
    """The tree with another value at a place; without it where the value is None's type."""
    holder = tree
    for key in path[:-1]:
        holder = holder[key]
    if value is KeyError:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    return tree


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("images", 1, "phi"), "x", r"images\[1\]\.phi: expected three numbers, got 'x'"),
        (("images", 0, "phi"), [1e9, 0, 0], r"images\[0\]: phi=.*no camera rotates by more than 1000 rad"),
        (("images", 0, "rms_px"), [1], r"images\[0\]\.rms_px: expected a number from 0"),
        (("images", 0, "sigma_phi"), [1, 2], r"images\[0\]\.sigma_phi: expected a list of 3, got \[1, 2\]"),
        (("images", 0, "camera_id"), "9", r"images\[0\]\.camera_id: '9' is not among rectified_cameras"),
        (("images", 0, "turned"), 9, r"images\[0\]\.turned: expected a whole number from 1 to 8, got 9"),
        (
            ("rectified_cameras", "1", "width"),
            2**31,
            r"rectified_cameras\.1\.width: expected .* to 32766, got 2147483648",
        ),
        (("rectified_cameras", "1", "K", 0, 0), 1e300, "expected focal lengths and a principal point of a camera"),
        (("quality",), "x", "quality: expected an object, got 'x'"),
        (("quality", "held_out_rms_px"), [1], r"quality\.held_out_rms_px: expected an object"),
        (("stages", 0, "seconds"), "x", r"stages\[0\]\.seconds: expected a number, got 'x'"),
        (("options", "raw_as"), "../x", r"options\.raw_as: expected one of tif, jpg, png"),
        (("critical_motion", "advice"), "x", r"critical_motion\.advice: expected a list"),
        (("generator",), [1], "generator: expected an object"),
        (("images", 0, "name"), "a\nb.jpg" + 100_000 * "x", None),
    ],
)
def test_a_solution_is_refused_by_its_place_before_any_work(tmp_path, path, value, says):
    (tmp_path / "s.json").write_text(json.dumps(changed(json.loads(json.dumps(solution())), path, value)))
    if says is None:  # of a name that long nothing can be said but that there is no such photo
        assert len(repr(read_solution(tmp_path / "s.json").images[0].name)) > 100_000
        return
    with pytest.raises(FormatError, match=says) as caught:
        read_solution(tmp_path / "s.json")
    assert len(str(caught.value)) < 500
    with pytest.raises(FormatError, match=says):
        rectify_folder(tmp_path, tmp_path / "s.json", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["num_points", "global_rms_px", "held_out_error", "readout_time", "sigma_intrinsics"])
def test_a_report_of_a_solution_that_tells_less(tmp_path, name):
    tree = changed(json.loads(json.dumps(solution())), ("quality", name), KeyError)
    del tree["critical_motion"]["anchors"], tree["stages"][0]["seconds"]
    (tmp_path / "solution.json").write_text(json.dumps(tree))
    with pytest.warns(UserWarning, match=r"report\.npz is missing"):
        assert write_report(tmp_path).is_file()


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    whole = read_solution_of(solution(), tmp_path)
    object.__setattr__(whole, "quality", {"rms_px": "x"})
    with pytest.raises(InputError, match=r"cannot be written: quality\.rms_px: expected a number"):
        write_solution(tmp_path / "t.json", whole)
    assert not (tmp_path / "t.json").exists()


def read_solution_of(tree, folder):
    (folder / "s.json").write_text(json.dumps(tree))
    return read_solution(folder / "s.json")


def png(width, height):
    """A PNG of 57 bytes that claims a size."""
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)), (b"IDAT", b""), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


@pytest.mark.parametrize("size", [(15_000, 15_000), (30_000, 30_000), (2**31 - 1, 2**31 - 1)])
def test_a_picture_that_claims_more_than_it_holds_is_not_decoded(tmp_path, size):
    path = tmp_path / "a.png"
    path.write_bytes(png(*size))
    for read in (read_photo, lambda path: read_mask(path, *size), read_depth_map):
        with pytest.raises(FileError, match=r"a\.png has \d+x\d+ pixels"):
            read(path)


def test_a_chunk_of_a_picture_that_claims_four_gigabytes_makes_no_room(tmp_path):
    whole = bytes(cv2.imencode(".png", np.full((48, 64), 255, np.uint8))[1])
    at = whole.index(b"IDAT") + 20
    (tmp_path / "a.png").write_bytes(whole[: at - 3] + whole[at:])  # what stands behind is no chunk any more
    for read in (read_photo, lambda path: read_mask(path, 64, 48), read_depth_map):
        with pytest.raises(FileError, match=r"a\.png (is cut short|cannot be decoded)"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize(
    "data",
    [
        claimed("(1000000000,)"), claimed("(-1,)"), claimed("(" * 500), claimed("(1,)", "|O"), claimed("'x'"), b"",
        b"PK\x03\x04", packed({"depth": np.zeros((40, 40_000_000 // 40))}),
    ],
    ids=["large", "negative", "nested", "objects", "text", "empty", "cut", "bomb"],
)  # fmt: skip
def test_an_array_that_claims_more_than_it_holds_makes_no_room(tmp_path, data):
    path = tmp_path / ("a.npz" if data[:2] == b"PK" else "a.npy")
    path.write_bytes(data)
    with pytest.raises(FormatError):
        read_arrays(path)
    with pytest.raises(FileError, match="depth map"):
        read_depth_map(path)


@pytest.mark.parametrize("name", ["names", "rgb", "row_mean_px", "histogram_px", "points_w"])
def test_diagnostics_of_no_dimension_or_another_type_are_named(tmp_path, name):
    for odd in (np.array(1.0), np.array(1j), np.array([True]), np.zeros((1, 1, 1, 1, 1), complex)):
        (tmp_path / "report.npz").write_bytes(packed({**report_arrays(), name: odd}))
        with pytest.raises(FormatError, match=name):
            read_diagnostics(tmp_path / "report.npz")


def test_a_grid_whose_source_has_no_size(tmp_path):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in (("map_x", np.eye(3)), ("map_y", np.eye(3)), ("source_size", np.array(3))):
            archive.writestr(f"{name}.npy", npy(array))
    (tmp_path / "g.npz").write_bytes(file.getvalue())
    with pytest.raises(FormatError, match="source_size"):
        RemapGrid.load(tmp_path / "g.npz")


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("surfaces", -1, "relief", "wavelength_m"), 1e-9, "a thousandth of size_m or more"),
        (("surfaces", -1, "relief", "cells"), [10**6, 10**6], "no more than 100000"),
        (("textures", "stone", "texels_per_m"), 1e9, "larger than any picture"),
        (("textures", "stone", "colour"), "x", "texture: colour='x'"),
        (("light", "sun"), [1, 2], r"light: sun\.shape"),
        (("render", "samples"), 10**9, "no more than 1024"),
        (("render", "jpeg_quality"), [1], "jpeg_quality"),
        (("points",), 10**30, "points="),
        (("surfaces", 1, "openings", 0, "size_m"), [1.0], r"size_m=\(1\.0,\), expected"),
        (("surfaces", 1, "openings", 0, "at_m"), 3, "at_m=3, expected"),
    ],
)
def test_a_recipe_that_nobody_could_render_is_refused_when_it_is_read(tmp_path, path, value, says):
    (tmp_path / "r.json").write_text(json.dumps(changed(json.loads(json.dumps(recipe())), path, value)))
    began = time.perf_counter()
    with pytest.raises(FormatError, match=says):
        load_recipe(tmp_path / "r.json")
    assert time.perf_counter() - began < 5


def test_a_name_with_a_line_break_does_not_make_a_model_that_nobody_reads():
    OutputOptions(sparse_format="bin").check_names(["a\nb.jpg"])
    with pytest.raises(InputError, match="has a line break in its name"):
        OutputOptions(sparse_format="txt").check_names(["a.jpg", "a\nb.jpg"])


def test_a_journal_that_is_nested_without_end_is_passed_over():
    assert entries_of("[" * 100_000 + "\n" + '{"a": ' * 100_000) == {}


def test_a_journal_of_empty_lines_takes_no_time():
    began = time.process_time()
    assert entries_of("\n{" * 25_000) == {}
    assert time.process_time() - began < 2


@pytest.mark.parametrize(
    "wrong", [{"files": {"a.png": math.inf}}, {"files": {"a.png": -1}}, {"depth": ["a", 10**400, 1]}]
)
def test_a_journal_with_sizes_that_no_file_has_is_passed_over(wrong):
    right = {"name": "a.jpg", "fingerprint": "f", "files": {"a.png": 12}, "turn": 1, "depth": ["d", 1.0, 2.0]}
    assert set(entries_of(json.dumps(right))) == {"a.jpg"}
    assert entries_of(json.dumps(right | wrong)) == {}


def test_a_number_that_no_float_holds_is_named(tmp_path):
    pose = '{"key": 1, "value": {"rotation": ' + "1" * 400 + "}}"
    start = '{"sfm_data_version": "0.3", "views": [], "intrinsics": [], "structure": [], "extrinsics": ['
    (tmp_path / "m.json").write_text(f"{start}{pose}]}}")
    with pytest.raises(FormatError, match=r"extrinsics\[0\]"):
        read_model(tmp_path / "m.json")


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("read", [read_colmap_cameras, partial(read_colmap_poses, any_lens=True), read_model])
def test_a_photo_in_a_colmap_model_whose_name_is_no_text_is_named(tmp_path, kind, read):
    files = colmap_files()[kind]
    damaged = files | {f"images.{kind}": files[f"images.{kind}"].replace(b".png", b".\xdbng", 1)}
    assert damaged != files
    for name, data in damaged.items():
        (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match=r"the name of image \d+ is not UTF-8"):
        read(tmp_path)


def test_a_mask_of_one_colour_is_small_and_is_read(tmp_path):
    """What the bound on a picture's size must let pass: zlib packs a thousand to one."""
    path = tmp_path / "m.png"
    encoded = cv2.imencode(".png", np.full((6000, 8000), 255, np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    path.write_bytes(bytes(encoded))
    assert read_mask(path, 8000, 6000).all()


# ---------------------------------------------------------------- surveys, other programs, what is kept


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (b"1000,2000", b"1e300,2000", "expected metres up to 1e"),
        (b"0.02,0.04", b"1e-300,0.04", "expected metres above 0"),
        (b"30.5,40", b"1e30,40", "pixels must be finite numbers up to"),
        (b"sigma_up", b"sigma_m", "two columns 'sigma'"),
        (b"10,20,", b"nan,20,", "line 2: x='nan', expected a number"),
    ],
)
def test_a_control_point_beyond_the_earth(tmp_path, old, new, says):
    (tmp_path / "c.csv").write_bytes(CONTROL.replace(old, new, 1))
    with pytest.raises(FormatError, match=says):
        read_control_points(tmp_path / "c.csv")


def test_a_length_whose_square_is_no_number(tmp_path):
    text = "photo1,x1,y1,photo2,x2,y2,length,sigma\na.jpg,1,2,b.jpg,3,4,1e200,0.01\n"
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(FormatError, match=r"line 2: .*length=1e\+200, expected above 0, up to"):
        read_known_lengths(tmp_path / "l.csv")


def test_a_heic_that_holds_no_picture_any_more(tmp_path):
    whole = raw_photos()["a.heic"]
    (tmp_path / "a.heic").write_bytes(whole.replace(b"infe", b"inf\0", 1))
    with pytest.raises(FileError, match=r"a\.heic cannot be decoded"):
        read_photo(tmp_path / "a.heic")
    (tmp_path / "a.heic").write_bytes(whole.replace(b"hvcC", b"hvc\0"))
    with pytest.raises(FileError, match=r"a\.heic cannot be decoded"):
        read_photo(tmp_path / "a.heic")


def test_a_video_whose_claims_ffmpeg_makes_no_room_for(tmp_path, monkeypatch):
    import av

    def refused(*_, **__):
        raise av.error.MemoryError(12, "Cannot allocate memory")

    monkeypatch.setattr(av, "open", refused)
    (tmp_path / "v.mp4").write_bytes(b"damaged")
    with pytest.raises(FileError, match=r"cannot be read as a video \(it claims more than FFmpeg makes room for\)"):
        read_gpmf(tmp_path / "v.mp4")


def test_entities_of_a_camera_file_are_not_expanded(tmp_path):
    levels = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
    text = f'<?xml version="1.0"?><!DOCTYPE d [<!ENTITY l0 "1 ">{levels}]><opencv_storage>&l9;</opencv_storage>'
    (tmp_path / "c.xml").write_text(text)
    with pytest.raises(FormatError, match="it declares a document type, in which entities hide"):
        read_camera_file(tmp_path / "c.xml", 64, 48)


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE keypoints SET data = x''", "cut short, or of another shape"),
        ("UPDATE keypoints SET data = 'x'", "cut short, or of another shape"),
        ("UPDATE keypoints SET rows = 'x'", "cut short, or of another shape"),
        ("UPDATE keypoints SET cols = 1, rows = rows * cols", "cut short, or of another shape"),
        ("UPDATE keypoints SET rows = -rows, cols = -cols", "cut short, or of another shape"),
        ("UPDATE keypoints SET rows = 0", "holds other keypoints"),
        ("UPDATE keypoints SET data = value(length(data), x'0000c07f')", "no numbers, or in no photo"),
        ("UPDATE matches SET data = value(length(data), x'ffffffff')", "keypoints that it does not hold"),
        ("UPDATE matches SET cols = 1, rows = rows * cols", "cut short, or of another shape"),
        ("ALTER TABLE matches RENAME TO old; CREATE VIEW matches AS SELECT * FROM old", "has no table matches"),
        (
            # which has no end
            "ALTER TABLE images RENAME TO old; CREATE VIEW images AS WITH RECURSIVE c(image_id, name) AS (SELECT 1, "
            "'x' UNION ALL SELECT image_id + 1, 'x' FROM c) SELECT * FROM c",
            "has no table images",
        ),
    ],
)
def test_a_database_of_other_shapes_than_colmaps(tmp_path, statement, says):
    files, _ = database()
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "d.db").write_bytes(altered(statement))
    rec = read_model(tmp_path).reconstruction
    (tmp_path / "work").mkdir()
    with pytest.raises((FileError, InputError), match=says) as caught:
        matched_of_database(tmp_path / "d.db", tmp_path / "work" / "ours.db", rec)
    assert "d.db" in str(caught.value)


def test_points_of_an_opf_project_that_claim_four_billion_measurements(tmp_path):
    pytest.importorskip("pyopf")
    for name, data in opf().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    assert len(read_model(tmp_path / "project.opf").reconstruction.observations) > 0
    (ranges,) = tmp_path.rglob("matchPointIndexRanges.bin")
    ranges.write_bytes(b"\xff" * ranges.stat().st_size)
    with pytest.raises(FormatError, match="points claim more measurements than its tracks hold"):
        read_model(tmp_path / "project.opf")


def test_points_of_an_opf_project_whose_colours_are_lost(tmp_path):
    pytest.importorskip("pyopf")
    for name, data in opf().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    (path,) = tmp_path.rglob("*.gltf")
    cloud = json.loads(path.read_text())
    (mesh,) = cloud["meshes"]
    cloud["accessors"][mesh["primitives"][0]["attributes"]["COLOR_0"]]["count"] = 0
    path.write_text(json.dumps(cloud))
    with pytest.raises(FormatError, match="points have 0 colours"):
        read_model(tmp_path / "project.opf")


@pytest.mark.parametrize(
    "line", [b"[" * 100_000, b'{"a": ' + b"9" * 5000 + b"}", b"\xff\xfe", b'{"scene": "x", "trial": 0, "method": "rs"}']
)
def test_a_line_of_trials_that_is_damaged_is_run_again(tmp_path, line):
    (tmp_path / "trials.jsonl").write_bytes(line + b"\n" + lines(TRIALS))
    assert list(read_trials(tmp_path / "trials.jsonl").values()) == TRIALS


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "\xff", '{"scenes": [1]}', '{"scenes": {"a": 1}}'])
def test_damaged_settings_of_an_experiment_are_named(tmp_path, text):
    path = tmp_path / "settings.json"
    path.write_text(json.dumps(SETTINGS))
    assert check_settings(path, {"seed": 0}, {}) == SETTINGS["scenes"]
    path.write_text(text, encoding="latin-1")
    with pytest.raises(FormatError, match=r"settings\.json cannot be read; give another folder"):
        check_settings(path, {"seed": 0}, {})


@pytest.mark.parametrize("name", ["R_cw", "center_w", "points_w", "frame_idx", "point_idx", "K", "width"])
def test_a_scene_with_an_array_of_no_dimension_or_five(tmp_path, name):
    for odd in (np.array(1), np.zeros((1, 1, 1, 1, 1))):
        if odd.ndim or name != "width":
            (tmp_path / "s.npz").write_bytes(packed({**scene(), name: odd}))
            with pytest.raises(FormatError, match=r"s\.npz is no scene: "):
                load_scene(tmp_path / "s.npz")


@pytest.mark.parametrize(
    "tree", ["[" * 100_000, '["array"]', '["tuple", 3]', '["range", [1, 2, 0]]', '["number", "x"]']
)
def test_a_kept_value_that_is_damaged_is_missing(tmp_path, tree):
    store = Kept(tmp_path, "k")
    store.begin()
    arrays = {**kept(), "tree": np.frombuffer(tree.encode(), np.uint8)}
    store.path("x").write_bytes(packed(arrays, compressed=False))
    assert store.get("x") is None
