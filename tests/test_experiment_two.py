"""The second experiment: camera paths of photos taken in motion, against the same photos taken still."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest
from arc_scene import PHOTOS, K, moved, scene_arrays
from click.testing import CliRunner
from make_photos import COURTYARD, COURTYARD_NAMES, half_courtyard, save_png, save_textures
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, Solution, SolvedImage
from rsundistort.errors import FileError, InputError, ReconstructionError
from rsundistort.experiments import TwoOptions, experiment_two, two
from rsundistort.experiments.paths import compare_paths
from rsundistort.experiments.plots import camera_paths, plan_axes
from rsundistort.synthetic import look_at

NAMES = [f"{k}.png" for k in range(PHOTOS)]


def solution_of(R_cw, center_w, names=None, model="rotation", lost=()):
    """A made-up solution; `lost` photos did not register."""
    camera = Camera(640, 480, K)
    images = []
    for i, name in enumerate(NAMES if names is None else names):
        if name in lost:
            images.append(SolvedImage(name, "1", reason="shares too little with the other photos"))
        else:
            images.append(SolvedImage(name, "1", R_cw[i], center_w[i], RowMotion([0.01, 0.02, 0.03])))
    options = {"camera": "as specified"}
    return Solution(
        model, {"1": camera}, {"1": camera.pinhole()}, tuple(images), options=options, quality={"rms_px": 0.5}
    )


@pytest.fixture
def poses():
    given = scene_arrays()
    return given["R_cw"], given["center_w"]


def test_comparison_does_not_see_the_world_frame(poses, rng):
    still = solution_of(*poses, model="global")
    found = compare_paths(still, solution_of(*moved(*poses, rng)), solution_of(*moved(*poses, rng), model="global"))
    assert found.names == tuple(NAMES)
    for key in ("with", "without"):
        assert found.centers_w[key] == pytest.approx(found.still_w, abs=1e-9)
        assert found.position[key] == pytest.approx(np.zeros(PHOTOS), abs=1e-9)
        assert found.rotation_deg[key] == pytest.approx(np.zeros(PHOTOS), abs=1e-6)
    assert np.linalg.norm(np.diff(found.still_w, axis=0), axis=1).mean() == pytest.approx(1)


def test_comparison_measures_in_baselines_and_degrees(poses, rng):
    R, center = poses
    baseline = np.linalg.norm(np.diff(center, axis=0), axis=1).mean()
    # two rotations about one axis of the world that cancel: the best common rotation is none
    axis = np.array([0.0, 0, np.radians(0.7)])
    turned = R.copy()
    turned[1] = R[1] @ Rotation.from_rotvec(axis).as_matrix()
    turned[4] = R[4] @ Rotation.from_rotvec(-axis).as_matrix()
    shifted = center.copy()
    shifted[2] += [0, 0, 0.03 * baseline]
    found = compare_paths(
        solution_of(R, center, model="global"),
        solution_of(*moved(turned, center, rng)),
        solution_of(*moved(R, shifted, rng), model="global"),
    )
    assert found.rotation_deg["with"] == pytest.approx([0, 0.7, 0, 0, 0.7, 0], abs=1e-6)
    assert found.position["with"] == pytest.approx(np.zeros(PHOTOS), abs=1e-9)
    assert found.rotation_deg["without"] == pytest.approx(np.zeros(PHOTOS), abs=1e-6)
    # the similarity takes up some of the shift, never all, and leaves the largest error where it is
    left = found.position["without"]
    assert left.argmax() == 2
    assert 0.015 < left[2] < 0.03
    assert left == pytest.approx(np.linalg.norm(found.centers_w["without"] - found.still_w, axis=1))
    assert np.sum(left**2) < 0.03**2


def test_comparison_takes_photos_that_all_three_have(poses, rng):
    order = rng.permutation(PHOTOS)
    shuffled = [NAMES[k] for k in order]
    R, center = moved(*poses, rng)
    found = compare_paths(
        solution_of(*poses, model="global", lost=["0.png"]),
        solution_of(R[order], center[order], names=shuffled, lost=["3.png"]),
        solution_of(*poses, model="global"),
    )
    assert found.names == ("1.png", "2.png", "4.png", "5.png")
    assert found.position["with"] == pytest.approx(np.zeros(4), abs=1e-9)
    with pytest.raises(
        InputError, match=r"2 photos were registered in all three .* \(4 still, 4 swung, 6 swung without"
    ):
        compare_paths(
            solution_of(*poses, lost=NAMES[:2]), solution_of(*poses, lost=NAMES[4:]), solution_of(*poses)
        )  # fmt: skip
    with pytest.raises(InputError, match="from one place"):
        compare_paths(solution_of(poses[0], np.ones((PHOTOS, 3))), solution_of(*poses), solution_of(*poses))


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("ahead", [1, -1])
def test_plan_view_is_seen_from_above_with_the_cameras_looking_up_the_page(rng, upside_down, ahead):
    # an arc in x, y; z is up; cameras look along y, a little down
    x = np.linspace(-3, 3, 7)
    center = np.stack([x, -0.2 * x**2, 0.01 * (-1.0) ** np.arange(7)], axis=1)
    R = np.array([look_at(c, c + np.array([0, ahead, -0.1]), 180.0 * upside_down) for c in center])
    # right x up points to the viewer, who is above the cameras: at -z when they hang upside down
    up = np.array([0.0, ahead, 0])
    right = np.cross(up, [0, 0, -1.0 if upside_down else 1.0])
    for _ in range(4):
        A = Rotation.random(random_state=rng).as_matrix()
        axes = plan_axes(center @ A.T, R @ A.T)
        assert axes @ A == pytest.approx(np.array([right, up]), abs=0.02)
        assert axes @ axes.T == pytest.approx(np.eye(2))


def test_picture_of_the_paths(poses, rng, tmp_path):
    R, center = poses
    bent = center + rng.normal(0, 0.1, center.shape)
    found = compare_paths(solution_of(R, center), solution_of(*moved(R, center, rng)), solution_of(R, bent))
    camera_paths(found, "constant-motion", tmp_path / "paths.png")
    picture = cv2.imread(str(tmp_path / "paths.png"))
    assert picture.shape[1] > picture.shape[0] > 400
    blue, green, red = picture.reshape(-1, 3).astype(int).T
    # both paths are drawn: tab:red and tab:blue
    assert ((red - blue > 120) & (red - green > 120)).sum() > 100
    assert ((blue - red > 120) & (blue - green > 40)).sum() > 100


@pytest.fixture
def folders(tmp_path):
    """Two folders of photos with the same names."""
    return save_textures(tmp_path / "still", NAMES, 32, 24), save_textures(tmp_path / "swung", NAMES, 32, 24)


@pytest.fixture
def made_up(monkeypatch, poses, rng):
    """`run` replaced: reconstructions without structure from motion; gives what it was called with."""
    R, center = poses
    bent = center + rng.normal(0, 0.2, center.shape)
    calls = []

    def fake(photos, out, options, progress=None, jobs=0):
        calls.append((photos.name, out.name, options, jobs))
        if progress is not None:
            progress("matching", 0, 0)
        out.mkdir()
        (out / "solution.json").write_text("{}")
        if photos.name == "still":
            return solution_of(R, center, model="global")
        if options.solve.shutter_model == "global":
            return solution_of(*moved(R, bent, rng), model="global", lost=["5.png"])
        return solution_of(*moved(R, center, rng), model="rotation")

    monkeypatch.setattr(two, "run", fake)
    return calls


def test_experiment_two_writes_what_it_promises(folders, made_up, tmp_path):
    out, steps = tmp_path / "out", []
    options = TwoOptions(camera="500,500,320,240", readout="bottom-to-top", seed=3, jobs=1)
    summary = experiment_two(*folders, out, options, lambda *args: steps.append(args))
    assert [(photos, name, o.solve.shutter_model) for photos, name, o, _ in made_up] == [
        ("still", "still", "global"),
        ("swung", "swung", "auto"),
        ("swung", "swung-global", "global"),
    ]
    for _, _, passed, jobs in made_up:
        assert (passed.camera, passed.solve.readout, passed.solve.seed, jobs) == (
            "500,500,320,240", "bottom-to-top", 3, 1,
        )  # fmt: skip
    assert [stage for stage, _, _ in steps] == ["still: matching", "swung: matching", "swung-global: matching"]
    assert sorted(path.name for path in out.iterdir()) == [
        ".rsundistort-written", "paths.png", "photos.csv", "still", "summary.json", "swung", "swung-global",
    ]  # fmt: skip
    assert json.loads((out / "summary.json").read_text()) == summary
    assert summary["photos"] == 6
    assert summary["compared"] == 5
    assert summary["registered"] == {"still": 6, "swung": 6, "swung-global": 5}
    assert list(summary["not_registered"]["swung-global"]) == ["5.png"]
    assert summary["shutter_model"] == "rotation"
    assert summary["with_shutter_model"]["position"]["max"] < 1e-9
    assert summary["with_shutter_model"]["rotation_deg"]["max"] < 1e-6
    figures = summary["without_shutter_model"]["position"]
    rows = list(csv.DictReader((out / "photos.csv").read_text().splitlines()))
    assert [row["photo"] for row in rows] == NAMES
    assert [row["registered_swung-global"] for row in rows] == ["1"] * 5 + ["0"]
    assert rows[5]["position_without"] == ""
    values = [float(row["position_without"]) for row in rows[:5]]
    assert figures["mean"] == pytest.approx(np.mean(values), rel=1e-4)
    assert figures["median"] == pytest.approx(np.median(values), rel=1e-4)
    assert figures["max"] == pytest.approx(max(values), rel=1e-4)
    assert figures["mean"] > 0.01
    assert cv2.imread(str(out / "paths.png")) is not None


def test_experiment_two_keeps_outputs_unless_specified(folders, made_up, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "summary.json").write_text("precious")
    with pytest.raises(FileError, match="not empty"):
        experiment_two(*folders, out)
    assert made_up == []
    assert (out / "summary.json").read_text() == "precious"
    with pytest.raises(FileError, match=r"summary\.json would be replaced"):
        experiment_two(*folders, out, TwoOptions(overwrite=True))
    assert made_up == []
    assert (out / "summary.json").read_text() == "precious"
    (out / "summary.json").unlink()
    for _ in range(2):
        experiment_two(*folders, out, TwoOptions(overwrite=True))
    assert (out / "summary.json").is_file()


def test_experiment_two_leaves_nothing_where_too_few_are_registered(folders, made_up, monkeypatch, poses, tmp_path):
    monkeypatch.setattr(two, "run", lambda *_, **__: solution_of(*poses, lost=NAMES[:4]))
    with pytest.raises(InputError, match="2 photos were registered in all three"):
        experiment_two(*folders, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_experiment_two_says_which_photos_cannot_be_registered(folders, made_up, monkeypatch, tmp_path):
    good = two.run

    def fake(photos, out, options, progress=None, jobs=0):
        if photos.name == "swung":
            raise ReconstructionError("only 2 of 6 photos could be registered")
        return good(photos, out, options, progress)

    monkeypatch.setattr(two, "run", fake)
    with pytest.raises(ReconstructionError, match="swung: only 2 of 6"):
        experiment_two(*folders, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_folders_of_different_photos_are_refused(folders, made_up, tmp_path):
    still, swung = folders
    with pytest.raises(InputError, match="is given twice"):
        experiment_two(still, still, tmp_path / "out")
    with pytest.raises(FileError, match="is no folder"):
        experiment_two(still, tmp_path / "missing", tmp_path / "out")
    (swung / "2.png").rename(swung / "9.png")
    with pytest.raises(InputError, match=r"still has 2\.png, which \S*swung has not"):
        experiment_two(still, swung, tmp_path / "out")
    (still / "2.png").unlink()
    (still / "1.png").unlink()
    with pytest.raises(InputError, match=r"swung has 1\.png and 1 more, which \S*still has not"):
        experiment_two(still, swung, tmp_path / "out")
    assert made_up == []
    assert not (tmp_path / "out").exists()


def test_outputs_do_not_go_into_the_photos(folders, made_up):
    for folder in folders:
        with pytest.raises(FileError, match="holds the photos"):
            experiment_two(*folders, folder, TwoOptions(overwrite=True))
    assert made_up == []


def test_model_to_compare_with_global_is_not_global():
    with pytest.raises(InputError, match="compared with"):
        TwoOptions(shutter_model="global")
    with pytest.raises(InputError, match="spiral"):
        TwoOptions(shutter_model="spiral")
    with pytest.raises(InputError, match="jobs=-1"):
        TwoOptions(jobs=-1)


def test_command_two(folders, made_up, tmp_path):
    args = ["experiment", "two", *map(str, folders), "-o", str(tmp_path / "out"), "--model", "two-step"]
    result = CliRunner().invoke(cli, args)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    assert "position error, baselines, with a shutter model     0.0000" in result.stdout
    assert "still 6, swung 6, swung-global 5 of 6; 5 compared" in result.stdout
    assert "swung-global: 5.png not registered" in result.stdout
    assert all(len(line) <= 100 for line in result.stdout.splitlines()[:5])
    assert made_up[1][2].solve.shutter_model == "two-step"
    again = CliRunner().invoke(cli, args)
    assert again.exit_code == 1
    assert "not empty" in again.stderr
    quiet = CliRunner().invoke(cli, [*args, "--overwrite", "--quiet"])
    assert quiet.exit_code == 0
    assert quiet.stdout == ""
    assert CliRunner().invoke(cli, [*args, "--model", "global"]).exit_code == 2


@pytest.mark.slow
def test_courtyard_swung_against_its_still_references(tmp_path):
    swung = half_courtyard(tmp_path / "swung")
    still = tmp_path / "still"
    still.mkdir()
    for name in COURTYARD_NAMES:
        full = cv2.imread(str(COURTYARD / "global" / name.replace(".png", ".jpg")))
        save_png(still / name, cv2.resize(full, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    options = TwoOptions(camera=str(tmp_path / "swung" / "camera.json"))
    summary = experiment_two(still, swung, tmp_path / "out", options)
    assert summary["compared"] == 6
    ours, blind = summary["with_shutter_model"], summary["without_shutter_model"]
    assert 0 < ours["rotation_deg"]["max"] < 0.2
    assert 0 < ours["position"]["max"] < 0.02
    assert ours["position"]["mean"] < 0.2 * blind["position"]["mean"]
    assert ours["rotation_deg"]["mean"] < 0.2 * blind["rotation_deg"]["mean"]
