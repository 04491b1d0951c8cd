"""What is written and said of a verdict, and which photos keep their motion by it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rsundistort_cli.closing import closing_table, summary
from scipy.spatial.transform import Rotation
from solved_scene import SCENES, solve_scene

from rsundistort import (
    Camera,
    RowMotion,
    RsUndistortWarning,
    Solution,
    SolvedImage,
    read_solution,
    rectify_folder,
)
from rsundistort.errors import FormatError
from rsundistort.io import write_solution
from rsundistort.rectify import largest_shift_px
from rsundistort.report import verdict_of
from rsundistort.report.displacement import displacement_field
from rsundistort.solve import model_sequence
from rsundistort.verdict import Verdict

LENS = (-0.1, 0.03, 0.0, 0.0)
CAMERA = Camera(800, 600, [[700, 0, 402], [0, 700, 297], [0, 0, 1]], LENS)


def test_a_verdict_is_kept_and_old_files_have_none(tmp_path):
    camera = replace(CAMERA, dist=())
    images = (
        SolvedImage("a.jpg", "1", motion=RowMotion([0.01, 0, 0]), doubtful="only 21 measurements", lens_only=True),
        SolvedImage("b.jpg", "1", motion=RowMotion([0.01, 0, 0])),
    )
    said = Verdict("found", "doubtful", ("The height is not known.",)).to_json()
    path = tmp_path / "solution.json"
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, images, verdict=said))
    value = json.loads(path.read_text())
    assert value["verdict"] == {"shutter": "found", "shape": "doubtful", "reasons": ["The height is not known."]}
    assert [(each["doubtful"], each["lens_only"]) for each in value["images"]] == [
        ("only 21 measurements", True), (None, False),
    ]  # fmt: skip
    again = read_solution(path)
    assert again.verdict == said
    assert [(each.doubtful, each.lens_only) for each in again.images] == [("only 21 measurements", True), (None, False)]
    # what was found stays, and is not taken out
    for one, other in zip(again.images, images, strict=True):
        np.testing.assert_array_equal(one.motion.phi, other.motion.phi)
    assert not again.images[0].taken_out.phi.any()
    assert again.images[1].taken_out is again.images[1].motion
    for each in value["images"]:
        del each["doubtful"], each["lens_only"]
    path.write_text(json.dumps({key: each for key, each in value.items() if key != "verdict"}))
    old = read_solution(path)
    assert old.verdict is None
    assert [(each.doubtful, each.lens_only) for each in old.images] == [(None, False)] * 2
    for wrong in ({"shutter": 1, "shape": "trusted", "reasons": []}, {"shape": "trusted"}, "found"):
        path.write_text(json.dumps(value | {"verdict": wrong}))
        with pytest.raises(FormatError, match=r"solution\.json"):
            read_solution(path)


@pytest.mark.parametrize(
    ("shutter", "model", "reasons", "level", "headline"),
    [
        ("found", "rotation", [], "trust", "The shape can be trusted"),
        ("not-found", "global", [], "still", "No correction needed"),
        ("not-found", "rotation", [], "still", "No correction needed"),
        ("found", "rotation", ["The lens is wrong."], "doubt", "The shape is doubtful"),
        ("not-found", "global", ["The lens is wrong."], "doubt", "The shape is doubtful"),
        ("not-determined", "global", ["It may be the lens."], "care", "The shutter is not determined"),
        ("not-determined", "rotation", ["It may be the lens."], "doubt", "The shutter is not determined"),
    ],
)
def test_report_and_closing_table_say_what_the_solution_says(shutter, model, reasons, level, headline):
    said = Verdict(shutter, "doubtful" if reasons else "trusted", tuple(reasons)).to_json()
    images = (SolvedImage("a.jpg", "1", motion=RowMotion([0.01, 0, 0]), rms_px=0.2, rs_shift_px=9.0),)
    quality = {"rms_px": 0.2, "global_rms_px": 1.0, "held_out_error": {}, "sigma_intrinsics": {}}
    solution = Solution(
        model, {"1": CAMERA}, {"1": CAMERA.pinhole()}, images, verdict=said, quality=quality,
        options={"camera": "camera.json", "readout": "top-to-bottom"},
    )  # fmt: skip
    verdict = verdict_of(solution)
    assert (verdict.level, verdict.headline) == (level, headline)
    assert all(reason in verdict.sentences[2] for reason in reasons)
    table = " ".join(closing_table(solution, Path("out")).split())
    assert f"verdict {headline}" in table
    assert verdict.sentences[2].strip() in table


@pytest.mark.parametrize(("tilted", "said"), [(0.0, True), (0.6, False)])
def test_no_shutter_is_found_but_for_a_motion_that_photos_held_level_share(tilted, said):
    """To first order, a nod that all of them share is the height of the scene (Ito and Okatani, section 4)."""
    turns = Rotation.from_euler("yxz", [[0.4 * k, tilted * k, tilted * k * k] for k in range(4)]).as_matrix()
    images = tuple(
        SolvedImage(f"{k}.jpg", "1", R.T, R @ [0, 0, -4.0], motion=RowMotion(), rs_shift_px=0.0)
        for k, R in enumerate(turns)
    )
    found = Verdict("not-found", "trusted").to_json()
    text = verdict_of(Solution("global", {"1": CAMERA}, {"1": CAMERA.pinhole()}, images, verdict=found)).sentences[2]
    assert "as good as that of a global shutter" in text
    assert ("a motion that all photos share would hardly show, because all cameras were held level" in text) == said


@pytest.fixture(scope="module")
def doubted(tmp_path_factory):
    """Outputs of the courtyard whose fourth photo has a motion that is not to be taken out."""
    out = tmp_path_factory.mktemp("doubted") / "out"
    judged = Verdict("found", "trusted", (), {"0003.jpg": "halves differ"}, ("0003.jpg",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_sequence, "judge", lambda *_: judged)
        with pytest.warns(RsUndistortWarning, match=r"1 photo is corrected for the lens only,.* 0003"):
            solution = solve_scene("courtyard", out, shutter_model="rotation", maps="npz")
    return out, solution


def test_of_such_a_photo_the_lens_alone_is_taken_out(doubted):
    out, solution = doubted
    image = solution.image("0003.jpg")
    assert (image.lens_only, image.doubtful, image.rs_shift_px) == (True, "halves differ", 0.0)
    assert largest_shift_px(solution.cameras["1"], image.motion) > 20
    # what OpenCV makes of it, which knows of no shutter
    camera, target = solution.cameras["1"], solution.rectified_cameras["1"]
    undistorted = cv2.initUndistortRectifyMap(
        camera.K, camera.dist, np.eye(3), target.K, (target.width, target.height), cv2.CV_32FC1
    )  # fmt: skip
    with np.load(out / "maps" / "0003.forward.npz") as maps:
        for name, expected in zip(("map_x", "map_y"), undistorted, strict=True):
            np.testing.assert_allclose(maps[name], expected, atol=2e-3)
    # keypoints of the model are where the rectified photo has them: its points are off by the shutter there alone
    model = pycolmap.Reconstruction(out / "sparse")
    errors = {}
    for each in model.images.values():
        seen = [(p.xy, each.project_point(model.points3D[p.point3D_id].xyz)) for p in each.points2D if p.has_point3D()]
        errors[each.name] = np.median([np.linalg.norm(xy - there) for xy, there in seen])
    assert errors.pop("0003.jpg") > 3
    assert max(errors.values()) < 1


def test_rectifying_by_the_solution_gives_the_same(doubted, tmp_path):
    out, solution = doubted
    again, _ = rectify_folder(SCENES / "courtyard" / "photos", out / "solution.json", tmp_path / "again", jobs=2)
    for name in ("0003", "0004"):
        for file in (f"images/{name}.jpg", f"masks/{name}.png"):
            assert (tmp_path / "again" / file).read_bytes() == (out / file).read_bytes()
    assert [image.lens_only for image in again.images] == [image.lens_only for image in solution.images]


def test_such_a_photo_is_named(doubted):
    out, solution = doubted
    table = closing_table(solution, out)
    assert "  0003.jpg: halves differ" in table
    assert "lens only" in table
    assert summary(solution, out, [])["lens_only"] == ["0003.jpg"]
    assert summary(solution, out, [])["doubtful"] == {"0003.jpg": "halves differ"}
    page = (out / "report.html").read_text()
    assert "<small>lens only</small>" in page
    assert "<small>doubtful: halves differ</small>" in page
    raw, still = displacement_field(solution, solution.image("0003.jpg"))
    np.testing.assert_allclose(raw, still, atol=1e-6)
    raw, still = displacement_field(solution, solution.image("0002.jpg"))
    assert np.linalg.norm(raw - still, axis=1).max() > 10


def test_frames_of_a_tripod_that_need_no_correction_have_no_shape():
    images = tuple(
        SolvedImage(f"{k}.png", "1", np.eye(3), np.zeros(3), motion=RowMotion(), rs_shift_px=0.1) for k in range(3)
    )
    time = {"seconds": 0.02, "sigma": 0.006, "source": "the video", "of_frame": 0.6}
    found = Verdict("not-found", "trusted").to_json()
    solution = Solution(
        "constant-motion", {"1": CAMERA}, {"1": CAMERA.pinhole()}, images, verdict=found,
        quality={"readout_time": time},
    )  # fmt: skip
    text = verdict_of(solution).sentences[2]
    assert "the camera only rotated, so that there is no scene" in text
    assert "as good as" not in text
    stands = replace(solution, quality={"readout_time": {**time, "stands": True}})
    assert "the camera hardly moved, so that there is no scene" in verdict_of(stands).sentences[2]
