from __future__ import annotations

import csv
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from arc_scene import PHOTOS, POINTS, K, scene_arrays
from click.testing import CliRunner
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Reconstruction
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.evaluation import rotation_angles_deg
from rsundistort.experiments import OneOptions, experiment_one, load_scene, one
from rsundistort.experiments.one import METHODS, draw_motions, draw_trial, errors_of, run_trial
from rsundistort.io import write_colmap_model
from rsundistort.model.reprojection import reprojection_residuals

PAIR = ("wo-rs", "constant-motion")
METRICS = {"rotation_deg", "translation", "structure", "iterations", "seconds"}


def save_scene(path, **changed):
    np.savez(path, **{**scene_arrays(), **changed})
    return path


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    return save_scene(tmp_path_factory.mktemp("scene") / "tiny.npz")


@pytest.fixture(scope="module")
def scene(scene_file):
    return load_scene(scene_file)


def lines_of(folder):
    return (folder / "trials.jsonl").read_text().splitlines()


def results_of(folder):
    """Lines by trial and method, without the time they took."""
    found = {}
    for line in lines_of(folder):
        entry = json.loads(line)
        assert entry.pop("seconds") >= 0
        assert (entry["trial"], entry["method"]) not in found
        found[entry["trial"], entry["method"]] = entry
    return found


@pytest.fixture(scope="module")
def two_trials(scene_file, tmp_path_factory):
    """The first two trials of two methods, by one process."""
    out = tmp_path_factory.mktemp("trials") / "two"
    summary = experiment_one([scene_file], out, OneOptions(trials=2, methods=PAIR, jobs=1))
    return out, summary


@pytest.fixture(scope="module")
def four_trials(scene_file, two_trials, tmp_path_factory):
    """Two more in a copy of that folder."""
    out = tmp_path_factory.mktemp("trials") / "four"
    shutil.copytree(two_trials[0], out)
    steps = []
    with pytest.MonkeyPatch.context() as patch:  # not in a process of their own: the first two were
        patch.setattr(one, "ProcessPoolExecutor", lambda count, _: ThreadPoolExecutor(count))
        summary = experiment_one(
            [scene_file], out, OneOptions(trials=4, methods=PAIR, jobs=1), lambda *args: steps.append(args)
        )
    return out, summary, steps


# ---------------------------------------------------------------- one: the protocol


def test_first_photo_has_no_motion_and_all_others_do(scene):
    motions = draw_motions(scene, OneOptions())
    assert len(motions) == PHOTOS
    assert not motions[0].phi.any()
    assert not motions[0].velocity.any()
    for motion in motions[1:]:
        assert motion.phi.all()
        assert motion.velocity.all()


def test_motions_are_drawn_once_for_all_trials(scene):
    first, _ = draw_trial(scene, OneOptions(trials=2), 0)
    for options, trial in ((OneOptions(trials=2), 1), (OneOptions(trials=50), 0), (OneOptions(trials=50), 49)):
        other, _ = draw_trial(scene, options, trial)
        assert np.array_equal(first.phi, other.phi)
        assert np.array_equal(first.velocity, other.velocity)
    other, _ = draw_trial(scene, OneOptions(seed=1), 0)
    assert not np.array_equal(first.phi, other.phi)


def test_noise_and_start_are_drawn_anew_in_each_trial(scene):
    (a, start_a), (b, start_b), (again, start_again) = (draw_trial(scene, OneOptions(), k) for k in (0, 1, 0))
    assert np.array_equal(a.observations.xy_raw, again.observations.xy_raw)
    assert np.array_equal(start_a.R_cw, start_again.R_cw)
    difference = a.observations.xy_raw - b.observations.xy_raw
    # two independent noises; 720 values know their standard deviation to 3 %
    assert difference.std() == pytest.approx(0.5 * np.sqrt(2), rel=0.1)
    for name in ("R_cw", "center_w", "points_w"):
        assert not np.array_equal(getattr(start_a, name), getattr(start_b, name))


def test_spread_of_the_motions_is_the_papers(scene):
    options = OneOptions(rotation_rad=0.05, translation=0.03)
    motions = [m for seed in range(400) for m in draw_motions(scene, replace(options, seed=seed))[1:]]
    span = 480 / 500  # the rows' range in normalised coordinates
    phi = np.array([m.phi for m in motions]) * span
    angle = np.linalg.norm(phi, axis=1)
    # of 2000 angles: the standard deviation of a normal variable is known to 1.6 %, three of which are the tolerance
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(0.05, rel=0.05)
    # the angle is normal, not its three components: those would have a mean of 1.6 sigma instead of 0.8
    assert angle.mean() == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.06)
    axis = phi / angle[:, None]
    assert np.abs(axis.mean(0)).max() < 4 / np.sqrt(3 * len(axis))
    assert np.abs(axis.T @ axis / len(axis) - np.eye(3) / 3).max() < 0.03  # sigma of an entry: 0.3 / sqrt(2000)
    # the scene's baseline is 1
    assert np.linalg.norm(np.diff(scene.center_w, axis=0), axis=1).mean() == pytest.approx(1)
    velocity = np.array([m.velocity for m in motions]) * span
    assert velocity.std(0) == pytest.approx([0.03] * 3, rel=0.05)
    assert np.abs(velocity.mean(0)).max() < 4 * 0.03 / np.sqrt(len(velocity))


def test_measurements_are_those_of_the_true_motion_and_noise(scene):
    truth, start = draw_trial(scene, OneOptions(), 0)
    assert len(truth.observations) == PHOTOS * POINTS
    res, valid = reprojection_residuals(truth)
    assert valid.all()
    assert res.std() == pytest.approx(0.5, rel=0.1)
    # without its motion the truth does not explain them: photos moved by up to 0.05 rad
    still, _ = reprojection_residuals(start, "global")
    assert still[truth.observations.frame_idx > 0].std() > 4


def test_start_is_as_far_from_the_truth_as_stated(scene):
    starts = [draw_trial(scene, OneOptions(start_rotation_deg=0.4, start_length=0.03), k) for k in range(40)]
    R = np.concatenate([np.einsum("mij,mkj->mik", start.R_cw, truth.R_cw) for truth, start in starts])
    moved = np.concatenate([start.center_w - truth.center_w for truth, start in starts])
    points = np.concatenate([start.points_w - truth.points_w for truth, start in starts])
    # 720 components: their standard deviation is known to 3 %
    assert np.sqrt(np.mean(rotation_angles_deg(R) ** 2) / 3) == pytest.approx(0.4, rel=0.1)
    assert moved.std() == pytest.approx(0.03, rel=0.1)
    assert points.std() == pytest.approx(0.03, rel=0.03)
    for _, start in starts:
        assert start.shutter_model == "global"
        assert not start.phi.any()
        assert not start.velocity.any()


def test_errors_do_not_see_a_similarity(scene, rng):
    truth, _ = draw_trial(scene, OneOptions(), 0)
    A = Rotation.random(random_state=rng).as_matrix()
    shift = rng.normal(size=3)
    moved = replace(
        truth,
        R_cw=truth.R_cw @ A.T,
        center_w=3 * truth.center_w @ A.T + shift,
        points_w=3 * truth.points_w @ A.T + shift,
    )
    assert max(errors_of(moved, truth).values()) < 1e-9


def test_errors_are_means_in_degrees_and_baselines(scene):
    truth, _ = draw_trial(scene, OneOptions(), 0)
    turn = Rotation.from_rotvec([0, 0, np.radians(0.6)]).as_matrix()
    R = np.array(truth.R_cw)
    R[1] = turn @ R[1]
    points = truth.points_w + np.array([0, 0.3, 0])
    errors = errors_of(replace(truth, R_cw=R, points_w=points), truth)
    assert errors["rotation_deg"] == pytest.approx(0.6 / PHOTOS, rel=1e-6)
    assert errors["translation"] == pytest.approx(0, abs=1e-9)
    assert errors["structure"] == pytest.approx(0.3, rel=1e-6)


def test_papers_anchor_holds_phi1_of_the_first_photo():
    assert METHODS["rs"] == ("two-step", False)
    assert METHODS["rs-star"] == ("two-step", True)
    assert METHODS["wo-rs"] == ("global", False)
    assert [name for name, (_, anchored) in METHODS.items() if anchored] == ["rs-star"]


def test_every_method_ends_and_the_anchor_costs_something(scene):
    lines = {line["method"]: line for line in run_trial(scene, OneOptions(), 0)}
    assert list(lines) == list(METHODS)
    for method, line in lines.items():
        # the paper's methods have no prior, ours one whose standard deviation is not given but estimated
        assert (line["phi_sigma"] < 0.1) == (method in ("rotation", "constant-motion"))
        assert line["phi_sigma"] < 0.1 or line["phi_sigma"] == 1e4
        assert line["stop_reason"] in ("cost", "step")
        assert 0 < line["rotation_deg"] < 5
        assert line["cost"] < line["true_cost"]
    # one unknown less; without a prior the costs are comparable
    assert lines["rs"]["cost"] < lines["rs-star"]["cost"] < lines["wo-rs"]["cost"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"methods": ("rs", "magic")}, "method 'magic', expected some of wo-rs"),
        ({"methods": ()}, "method 'none'"),
        ({"noise_px": 0.0}, "noise_px=0"),
        ({"rotation_rad": -0.1}, "rotation_rad=-0.1"),
        ({"translation": float("nan")}, "translation=nan"),
        ({"start_length": float("inf")}, "start_length=inf"),
        ({"trials": 0}, "trials"),
        ({"jobs": -1}, "jobs"),
    ],
)
def test_protocols_that_make_no_sense_are_refused(changed, message):
    with pytest.raises(InputError, match=message):
        OneOptions(**changed)


# ---------------------------------------------------------------- one: the folder


def test_summary_holds_medians_and_percentiles_of_the_trials(four_trials):
    out, summary, _ = four_trials
    assert json.loads((out / "summary.json").read_text()) == summary
    assert list(summary) == ["tiny"]
    assert list(summary["tiny"]) == list(PAIR)
    entries = [json.loads(line) for line in lines_of(out)]
    for method, metrics in summary["tiny"].items():
        assert set(metrics) == METRICS
        for metric, figures in metrics.items():
            values = [entry[metric] for entry in entries if entry["method"] == method]
            assert len(values) == 4
            assert figures == {"median": np.median(values), "p90": np.percentile(values, 90)}
    rows = list(csv.DictReader((out / "summary.csv").read_text().splitlines()))
    assert len(rows) == len(PAIR) * len(METRICS)
    assert float(rows[0]["median"]) == pytest.approx(summary["tiny"]["wo-rs"]["rotation_deg"]["median"], rel=1e-5)
    assert cv2.imread(str(out / "histograms.png")).shape[0] > 400


def test_constant_motion_beats_no_shutter_model(four_trials):
    out, summary, _ = four_trials
    entries = results_of(out)
    for trial in range(4):
        ours = entries[trial, "constant-motion"]
        # least squares ends below the truth by half a unit for each unknown, fewer where the prior holds them
        unknowns = 12 * PHOTOS + 3 * POINTS - 7
        assert ours["true_cost"] - unknowns < ours["cost"] < ours["true_cost"]
        # angles of 0.05 about any axis: most components are far smaller, and the scale of Student's t is theirs
        assert 0.006 < ours["phi_sigma"] < 0.06
        assert 0.02 < ours["velocity_sigma"] < 0.08
    for metric in ("rotation_deg", "translation", "structure"):
        blind, ours = (summary["tiny"][method][metric]["median"] for method in PAIR)
        assert 0 < ours < 0.6 * blind  # measured: 0.3 to 0.4


def test_finished_trials_are_not_run_again(two_trials, four_trials):
    before, after = lines_of(two_trials[0]), lines_of(four_trials[0])
    assert len(before) == 4
    assert after[:4] == before
    assert set(results_of(four_trials[0])) == {(trial, method) for trial in range(4) for method in PAIR}
    steps = four_trials[2]
    assert steps[0] == ("trials", 0, 2)
    assert steps[-1] == ("trials", 2, 2)


def test_a_torn_last_line_is_run_again(scene_file, two_trials, tmp_path):
    out = tmp_path / "torn"
    shutil.copytree(two_trials[0], out)
    text = (out / "trials.jsonl").read_text()
    (out / "trials.jsonl").write_text(text[:-40])
    experiment_one([scene_file], out, OneOptions(trials=2, methods=PAIR, jobs=1))
    assert lines_of(out)[:3] == text.splitlines()[:3]
    assert len(lines_of(out)) == 4
    assert results_of(out) == results_of(two_trials[0])


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_jobs(scene_file, two_trials, tmp_path):
    experiment_one([scene_file], tmp_path, OneOptions(trials=2, methods=PAIR, jobs=2))
    assert results_of(tmp_path) == results_of(two_trials[0])


def test_a_folder_takes_trials_of_one_protocol_only(scene_file, two_trials, tmp_path):
    out = two_trials[0]
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(InputError, match=r"holds trials with another seed \(0, not 1\)"):
        experiment_one([scene_file], out, OneOptions(trials=2, methods=PAIR, seed=1))
    with pytest.raises(InputError, match="another translation"):
        experiment_one([scene_file], out, OneOptions(trials=2, methods=PAIR, translation=0.0))
    other = save_scene(tmp_path / "tiny.npz", width=641)
    with pytest.raises(InputError, match="holds trials of another scene called tiny"):
        experiment_one([other], out, OneOptions(trials=2, methods=PAIR))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_scenes_of_one_name_are_refused(scene_file, tmp_path):
    with pytest.raises(InputError, match="two scenes are called 'tiny'"):
        experiment_one([scene_file, scene_file], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_folders_that_cannot_be_used(scene_file, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError, match="is a file"):
        experiment_one([scene_file], tmp_path / "file")
    (tmp_path / "settings.json").write_text('{"seed": ')
    with pytest.raises(FormatError, match=r"settings\.json cannot be read"):
        experiment_one([scene_file], tmp_path)


def test_command_one_shows_finished_trials(scene_file, two_trials, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(two_trials[0], out)
    args = ["experiment", "one", scene_file, "-o", out, "--trials", "2", "--method", PAIR[0], "--method", PAIR[1]]
    result = CliRunner().invoke(cli, [str(arg) for arg in args])
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[:2] for row in rows[1:3]] == [["tiny", "wo-rs"], ["tiny", "constant-motion"]]
    assert float(rows[1][2]) == pytest.approx(two_trials[1]["tiny"]["wo-rs"]["rotation_deg"]["median"], abs=1e-4)
    assert lines_of(out) == lines_of(two_trials[0])


# ---------------------------------------------------------------- one: scenes


def test_scene_is_in_baselines(scene):
    assert scene.name == "tiny"
    assert scene.num_images == PHOTOS
    given = scene_arrays()
    step = np.linalg.norm(np.diff(given["center_w"], axis=0), axis=1).mean()
    assert scene.center_w == pytest.approx(given["center_w"] / step)
    assert scene.points_w == pytest.approx(given["points_w"] / step)


def test_points_that_one_photo_sees_are_left_out(tmp_path):
    given = scene_arrays()
    kept = (given["point_idx"] != 7) | (given["frame_idx"] == 3)
    path = save_scene(tmp_path / "s.npz", frame_idx=given["frame_idx"][kept], point_idx=given["point_idx"][kept])
    scene, whole = load_scene(path), load_scene(save_scene(tmp_path / "whole.npz"))
    assert scene.points_w == pytest.approx(np.delete(whole.points_w, 7, axis=0))
    assert len(scene.frame_idx) == PHOTOS * (POINTS - 1)
    assert scene.point_idx.max() == POINTS - 2


def test_tracks_of_a_rendered_scene_are_called_by_their_folder(tmp_path):
    (tmp_path / "garden").mkdir()
    assert load_scene(save_scene(tmp_path / "garden" / "tracks.npz")).name == "garden"


def first(count):
    """The scene cut to its first photos."""
    given = scene_arrays()
    kept = given["frame_idx"] < count
    return {
        "R_cw": given["R_cw"][:count],
        "center_w": given["center_w"][:count],
        "frame_idx": given["frame_idx"][kept],
        "point_idx": given["point_idx"][kept],
    }


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        (first(2), InputError, "has 2 photos; the experiment needs at least three"),
        ({"K": np.stack([K] * PHOTOS)}, InputError, "has several cameras"),
        ({"center_w": np.ones((PHOTOS, 3))}, InputError, "taken from one place"),
        ({"center_w": np.full((PHOTOS, 3), np.nan)}, FormatError, "center_w holds NaN"),
        ({"R_cw": np.ones((PHOTOS, 3, 3))}, FormatError, "no rotation"),
        ({"R_cw": np.ones((PHOTOS, 4, 4))}, FormatError, r"R_cw\.shape"),
        ({"point_idx": np.arange(PHOTOS * POINTS)}, FormatError, "point_idx goes from 0 to 359, expected 0 to 59"),
        ({"frame_idx": np.zeros(3, int)}, FormatError, r"point_idx\.shape"),
        ({"frame_idx": np.zeros(PHOTOS * POINTS, int)}, InputError, "shares no point"),
        ({"width": np.ones(2)}, FormatError, "single numbers"),
        ({"K": np.array([["a"] * 3] * 3)}, FormatError, "K holds <U1, expected numbers"),
        ({"K": np.zeros((3, 3))}, FormatError, "both must be positive"),
        ({"points_w": np.array([None, 1], object)}, FormatError, "is garbled: its type is object"),
    ],
)
def test_scenes_that_cannot_be_used(tmp_path, changed, error, message):
    with pytest.raises(error, match=message) as caught:
        load_scene(save_scene(tmp_path / "bad.npz", **changed))
    assert "bad" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_scene(tmp_path, scene_file):
    whole = scene_file.read_bytes()
    garbled = bytearray(whole)
    garbled[100:200] = b"x" * 100
    for name, content in (("empty", b""), ("text", b"hello"), ("cut", whole[: len(whole) // 2]), ("bad", garbled)):
        (tmp_path / f"{name}.npz").write_bytes(content)
        with pytest.raises(FormatError, match=rf"{name}\.npz is garbled"):
            load_scene(tmp_path / f"{name}.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    with pytest.raises(FormatError, match="single array"):
        load_scene(tmp_path / "array.npz")
    np.savez(tmp_path / "lacking.npz", K=K)
    with pytest.raises(FormatError, match="width"):
        load_scene(tmp_path / "lacking.npz")
    with pytest.raises(FileError, match="No such file"):
        load_scene(tmp_path / "missing.npz")
    with pytest.raises(FileError, match="is no scene; give"):
        load_scene(tmp_path / "missing")
    with pytest.raises(FileError, match="is no COLMAP model"):
        load_scene(tmp_path)


def colmap_of(scene, folder, names, cameras=1):
    """The scene as a COLMAP model, measured without noise and motion."""
    truth, _ = draw_trial(scene, OneOptions(rotation_rad=0, translation=0, noise_px=1e-9), 0)
    K_other = K + np.diag([1.0, 1.0, 0])
    both = [scene.camera, Camera(640, 480, K_other)][:cameras]
    model = Reconstruction(
        both,
        names,
        np.arange(PHOTOS) % cameras,
        truth.R_cw,
        truth.center_w,
        truth.points_w,
        truth.observations,
        truth.phi,
        truth.velocity,
        "global",
    )
    write_colmap_model(folder, model, [camera.pinhole() for camera in both], names)


@pytest.mark.parametrize("inside", [".", "sparse"])
def test_scene_from_a_colmap_model_and_from_the_output_of_a_run(scene, tmp_path, inside):
    names = [f"{k}.png" for k in range(PHOTOS)][::-1]
    some = (scene.point_idx + 2 * scene.frame_idx) % 3 > 0
    scene = replace(scene, frame_idx=scene.frame_idx[some], point_idx=scene.point_idx[some])
    colmap_of(scene, tmp_path / "model" / inside, names)
    found = load_scene(tmp_path / "model")
    assert found.name == "model"
    assert found.camera == scene.camera
    # photos in the order of their names, here the other way round
    assert found.R_cw == pytest.approx(scene.R_cw[::-1])
    assert found.center_w == pytest.approx(scene.center_w[::-1])
    assert found.points_w == pytest.approx(scene.points_w)
    pairs = set(zip(found.frame_idx.tolist(), found.point_idx.tolist(), strict=True))
    assert pairs == set(zip((PHOTOS - 1 - scene.frame_idx).tolist(), scene.point_idx.tolist(), strict=True))


def test_colmap_model_of_several_cameras_is_refused(scene, tmp_path):
    colmap_of(scene, tmp_path / "model", [f"{k}.png" for k in range(PHOTOS)], cameras=2)
    with pytest.raises(InputError, match="has 2 cameras; the experiment takes scenes of one"):
        load_scene(tmp_path / "model")
