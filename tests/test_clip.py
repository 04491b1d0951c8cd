"""Clips of one path: against formulas written anew here, line by line, and the files that come of them."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import DepthMap, evaluate, read_solution, rectify
from rsundistort.batch import RectifyOptions, rectify_folder
from rsundistort.errors import FormatError, InputError
from rsundistort.evaluation import psnr
from rsundistort.io import read_photo
from rsundistort.io.video import extract_frames
from rsundistort.io.video_writer import write_video
from rsundistort.simulate import SceneOptions, simulate_scene
from rsundistort.synthetic import load_recipe, render_depth, render_view
from rsundistort.synthetic.clip import Tremor
from rsundistort.synthetic.render import line_poses, pixel_rays

WALK = Path(__file__).parents[1] / "sample_scenes" / "walk"
WAY = [
    {"center_w": [-0.6, -0.2, 0.1], "look_at_w": [-0.9, 4, 0.4], "roll_deg": 2},
    {"center_w": [0.1, 0.0, 0.0], "look_at_w": [0.2, 4, -0.3], "roll_deg": -1},
    {"center_w": [0.5, 0.3, 0.2], "look_at_w": [0.3, 4, 0.1], "roll_deg": 0},
    {"center_w": [0.6, 0.7, 0.1], "look_at_w": [0.9, 4, 0.3], "roll_deg": 4},
]
PATH = {
    "kind": "walk", "fps": 25, "num_frames": 11, "readout": 0.6, "way": WAY,
    "tremor": {"rotation_deg": 1.5, "travel_m": 0.01, "hz": [1, 12], "num": 5},
    "steps": {"hz": 1.9, "up_m": 0.02, "side_m": 0.015},
}  # fmt: skip
PAN = {
    "kind": "pan", "fps": 25, "duration_s": 0.2, "readout": 0.8, "center_w": [0.1, 0.2, 0.3],
    "way": [{"look_at_w": [-1, 4, 0]}, {"look_at_w": [1, 4, 0.5], "roll_deg": 3}], "tremor": {"rotation_deg": 2},
}  # fmt: skip
TINY = {
    "format": "rsundistort-recipe", "version": 1, "name": "tiny", "seed": 3,
    "camera": {
        "width": 48, "height": 32, "K": [[40, 0, 24.5], [0, 41, 13.25], [0, 0, 1]], "dist": [],
        "readout": "top-to-bottom",
    },
    "render": {"samples": 4, "jpeg_quality": 94},
    "light": {},
    "textures": {"grey": {"kind": "ground", "size_m": [2, 2], "texels_per_m": 16, "colour": [150, 150, 150]}},
    "surfaces": [
        {"kind": "rectangle", "origin_w": [-6, 4, -6], "edge_a": [12, 0, 0], "edge_b": [0, 0, 12], "texture": "grey"},
        {"kind": "box", "center_w": [0.2, 2.5, -1], "size_m": [0.4, 0.4, 1], "texture": "grey"},
    ],
    "path": PATH,
    "twins": {"every": 4},
}  # fmt: skip


def recipe_of(folder, **changes):
    """The tiny recipe with changes, loaded; a change to None takes an entry away."""
    data = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    (folder / "recipe.json").write_text(json.dumps(data))
    return load_recipe(folder / "recipe.json")


def rodrigues(turn):
    """Exp of a rotation vector, by the series' closed form."""
    angle = np.linalg.norm(turn)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def walk_at(t, tremor, end_s):
    """The pose of PATH at one time, by polynomials, cross products and sines one by one."""
    place = np.linspace(0, end_s, 4)

    def along(values):
        # four points: the one cubic through them
        return np.array([np.polyval(np.polyfit(place, column, 3), t) for column in np.array(values, float).T])

    center, target = along([p["center_w"] for p in WAY]), along([p["look_at_w"] for p in WAY])
    roll = np.radians(along([[p["roll_deg"]] for p in WAY])[0])
    z = (target - center) / np.linalg.norm(target - center)
    right = np.array([z[1], -z[0], 0]) / np.hypot(z[0], z[1])
    down = np.cross(z, right)
    look = np.array([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, z])
    shake = np.zeros(6)
    rate, phase, amplitude = tremor.waves
    for wave in range(5):
        for axis in range(6):
            shake[axis] += amplitude[wave, axis] * np.sin(rate[wave, axis] * t + phase[wave, axis])
    step = 2 * np.pi * 1.9 * t
    center = center + shake[3:] + [0, 0, 0.02 * np.sin(step)] + 0.015 * np.sin(step / 2) * right
    return rodrigues(shake[:3]) @ look, center


@pytest.mark.parametrize("readout", ["top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left"])
def test_each_line_has_the_pose_of_the_path_at_its_time(tmp_path, readout):
    recipe = recipe_of(tmp_path, camera={**TINY["camera"], "readout": readout})
    lines, at = (32, 13.25) if readout in ("top-to-bottom", "bottom-to-top") else (48, 24.5)
    sign = 1 if readout in ("top-to-bottom", "left-to-right") else -1
    for k in (0, 5, 10):
        R_cw, center_w = line_poses(recipe.cameras["1"], recipe.views[k])
        for line in range(0, lines, 5):
            # the frame is read in 0.6 of the time from one to the next
            t = k / 25 + sign * (line - at) / lines * 0.6 / 25
            R, center = walk_at(t, recipe.clip.path.tremor, 10 / 25)
            # what a spline of 17 readings leaves of 12 Hz in 24 ms
            np.testing.assert_allclose(R_cw[line], R, atol=2e-8)
            np.testing.assert_allclose(center_w[line], center, atol=1e-9)


def test_tremor_has_the_amplitude_and_the_frequencies_asked_for():
    tremor = Tremor(0.03, 0.01, (2.0, 9.0), 4, seed=5)
    rate, _, amplitude = tremor.waves
    hz = rate / (2 * np.pi)
    edges = 2 * 4.5 ** (np.arange(5) / 4)
    assert ((hz >= edges[:-1, None]) & (hz <= edges[1:, None])).all()
    # a slow one is as fast as a quick one, since it is wide
    np.testing.assert_allclose(amplitude * rate, np.broadcast_to((amplitude * rate)[0], (4, 6)))
    turn, way = tremor.at(np.linspace(0, 500, 100_001))
    np.testing.assert_allclose(np.sqrt((turn**2).mean(0)), 0.03, rtol=1e-2)
    np.testing.assert_allclose(np.sqrt((way**2).mean(0)), 0.01, rtol=1e-2)
    assert (Tremor(0.03, 0.01, (2.0, 9.0), 4, seed=6).waves[1] != tremor.waves[1]).all()


def test_motion_is_the_speed_of_the_path_times_the_readout(tmp_path):
    # about the middle of the frame, so that what is left shrinks with the square of the readout
    middle = {**TINY["camera"], "K": [[40, 0, 23.5], [0, 41, 15.5], [0, 0, 1]]}
    misses = []
    for readout in (0.8, 0.2):
        recipe = recipe_of(tmp_path, camera=middle, path={**PATH, "readout": readout})
        found = []
        for k, view in enumerate(recipe.views):
            t, h = k / 25, 1e-5
            (R0, c0), (R1, c1) = (walk_at(at, recipe.clip.path.tremor, 10 / 25) for at in (t - h, t + h))
            omega = Rotation.from_matrix(R1 @ R0.T).as_rotvec() / (2 * h)
            rho = readout / 25 / (32 / 41)  # seconds a unit of the clock
            found.append([view.motion.phi / rho - omega, view.motion.velocity / rho - (c1 - c0) / (2 * h)])
            assert np.linalg.norm(omega) > 0.02
        misses.append(np.abs(found).max(axis=(0, 2)))
    assert misses[0][0] < 0.2
    np.testing.assert_allclose(misses[0] / misses[1], 16, rtol=0.2)


def test_a_pan_rotates_about_one_place(tmp_path):
    recipe = recipe_of(tmp_path, path=PAN)
    assert len(recipe.views) == 5
    assert recipe.clip.readout_s == pytest.approx(0.032)
    uv = np.array([[0.0, 0], [47, 31], [3, 20]])
    for view in recipe.views:
        assert not view.motion.moves
        np.testing.assert_array_equal(pixel_rays(recipe.cameras["1"], view, uv)[0], [[0.1, 0.2, 0.3]] * 3)
    turned = Rotation.from_matrix(recipe.views[-1].R_cw @ recipe.views[0].R_cw.T).magnitude()
    assert turned > np.radians(10)


def test_a_camera_on_a_tripod_without_tremor_stands_still(tmp_path):
    still = {**PAN, "way": PAN["way"][:1], "tremor": {}}
    first, *others = recipe_of(tmp_path, path=still).views
    for view in others:
        np.testing.assert_array_equal(view.R_cw, first.R_cw)
        assert np.abs(view.motion.at(0.3)[0]).max() < 1e-14


def test_y_axes_of_a_level_clip_are_parallel_at_all_times(tmp_path):
    way = [{key: point[key] for key in ("center_w", "look_at_w")} for point in WAY]
    recipe = recipe_of(tmp_path, path={**PATH, "level": True, "way": way})
    for view in recipe.views:
        R_cw, _ = line_poses(recipe.cameras["1"], view)
        np.testing.assert_allclose(R_cw[:, 1], np.broadcast_to([0, 0, -1], (32, 3)), atol=1e-12)
        assert np.abs(view.motion.phi[1]) > 1e-4
    assert np.ptp([view.center_w[2] for view in recipe.views]) > 0.02


def test_a_clip_is_written_with_its_truth_and_references(tmp_path):
    pytest.importorskip("av")
    source = tmp_path / "source"
    source.mkdir()
    recipe = recipe_of(source)
    for out in ("a", "b"):
        simulate_scene(source / "recipe.json", tmp_path / out)
    names = sorted(p.relative_to(tmp_path / "a").as_posix() for p in (tmp_path / "a").rglob("*") if p.is_file())
    references = [f"clip_{k:06d}" for k in (0, 4, 8)]
    assert names == sorted([
        ".rsundistort-written", "camera.json", "clip.mp4", "ground_truth.json", "recipe.json", "tracks.npz",
        *(f"global/{stem}.jpg" for stem in references),
        *(f"{folder}/{stem}.tif" for folder in ("depth", "global-depth") for stem in references),
    ])  # fmt: skip
    for name in names[1:]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()

    frames = extract_frames(tmp_path / "a" / "clip.mp4", tmp_path / "frames", every=1)
    truth = read_solution(tmp_path / "a" / "ground_truth.json")
    assert tuple(image.name for image in truth.images) == frames.names == recipe.clip.names
    assert truth.options["video"]["name"] == "clip.mp4"
    np.testing.assert_allclose(truth.options["video"]["time_s"], frames.time_s, atol=1e-6)
    np.testing.assert_allclose(frames.time_s, np.arange(11) / 25, atol=1e-6)
    assert truth.quality["readout_time"] == {"seconds": pytest.approx(0.024), "sigma": 0.0, "source": "recipe"}
    assert truth.options["readout_ms"] == pytest.approx(24)
    for image, view in zip(truth.images, recipe.views, strict=True):
        back = replace(view, R_cw=image.R_cw, center_w=image.center_w, motion=image.motion)
        for stated, rendered in zip(
            line_poses(recipe.cameras["1"], back), line_poses(recipe.cameras["1"], view), strict=True
        ):
            np.testing.assert_allclose(stated, rendered, atol=1e-13)
    # a decoded frame is the photo but for the coding
    photo = render_view(recipe.scene, recipe.cameras["1"], recipe.views[5], samples=4)
    frame = read_photo(tmp_path / "frames" / "clip_000005.png").pixels
    assert psnr(photo, frame) > 40

    # frames are judged by the references that there are
    options = RectifyOptions(depth="infinity")
    rectify_folder(tmp_path / "frames", tmp_path / "a" / "ground_truth.json", tmp_path / "back", options)
    (tmp_path / "back" / "solution.json").write_bytes((tmp_path / "a" / "ground_truth.json").read_bytes())
    found = evaluate(tmp_path / "back", tmp_path / "a" / "ground_truth.json", raw=tmp_path / "frames")
    assert sorted(found.psnr_db.photos) == [f"{stem}.png" for stem in references]
    assert found.rotation_deg.max < 1e-9


def test_two_frames_are_a_clip(tmp_path):
    path = {**PATH, "num_frames": 2, "way": WAY[:2]}
    recipe = recipe_of(tmp_path, path=path, twins=None)
    assert [view.name for view in recipe.views] == ["clip_000000.png", "clip_000001.png"]
    assert [view.name for view in recipe.references] == ["clip_000000.png"]


def test_exposure_of_a_clip_is_a_share_of_its_readout(tmp_path):
    view = recipe_of(tmp_path, shutter={"exposure_ms": 6}).views[0]
    assert view.exposure == pytest.approx(32 / 41 / 4)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"path": {**PATH, "readout": 1.2}}, "readout=1.2, expected a share"),
        ({"path": {**PATH, "readout": 0}}, "readout=0, expected"),
        ({"path": {**PATH, "fps": 0}}, "fps=0"),
        ({"path": {**PATH, "num_frames": 1}}, "1 frames, a clip needs two"),
        ({"path": {**PATH, "duration_s": 1}}, "either num_frames or duration_s"),
        ({"path": {**PATH, "way": []}}, "way has no points"),
        ({"path": {**PATH, "way": [{"look_at_w": [0, 1, 0]}]}}, r"way\[0\]: missing key 'center_w'"),
        ({"path": {**PATH, "way": [{"center_w": [0, 0, 0], "look_at_w": [0, 0, 0]}]}}, "cannot look at the point"),
        ({"path": {**PATH, "level": 1}}, "level=1, expected true or false"),
        ({"path": {**PATH, "level": True}}, r"way\[0\]: unknown key 'roll_deg'"),
        ({"path": {**PATH, "speed": 1}}, "unknown key 'speed'"),
        ({"path": {**PATH, "tremor": {"hz": [3, 1]}}}, "hz=3 to 1"),
        ({"path": {**PATH, "tremor": {"hz": 3}}}, "tremor: hz"),
        ({"path": {**PATH, "tremor": {"rotation_deg": -1}}}, "expected 0 or more"),
        ({"path": {**PATH, "steps": {"left": 1}}}, "steps: unknown key 'left'"),
        ({"path": {**PAN, "steps": {}}}, "unknown key 'steps'"),
        ({"path": {**PAN, "tremor": {"travel_m": 1}}}, "unknown key 'travel_m'"),
        ({"path": {"kind": "run"}}, "missing key 'motion'|unknown key 'twins'"),
        ({"motion": {"kind": "none"}}, "unknown key 'motion'"),
        ({"twins": {"every": 0}}, "twins: every: 0"),
        ({"shutter": {"readout_ms": 20}}, "unknown key 'readout_ms'"),
        ({"camera": {**TINY["camera"], "width": 47}}, "47x32 pixels; a clip needs an even width"),
        ({"camera": None, "cameras": {"a": TINY["camera"], "b": TINY["camera"]}}, "taken by one camera, got 2"),
    ],
)
def test_clips_that_make_no_sense_are_refused_in_one_line(tmp_path, changes, says):
    with pytest.raises(FormatError, match=says) as error:
        recipe_of(tmp_path, **changes)
    assert "\n" not in str(error.value)


def test_a_video_of_odd_size_is_refused(tmp_path):
    pytest.importorskip("av")
    with pytest.raises(InputError, match=r"7x4 pixels: H\.264 needs an even width"):
        write_video(tmp_path / "a.mp4", [np.zeros((4, 7, 3), np.uint8)], Fraction(25))


def test_committed_walk_is_what_its_recipe_makes():
    recipe, truth = load_recipe(WALK / "recipe.json"), read_solution(WALK / "ground_truth.json")
    assert [view.name for view in recipe.views] == [image.name for image in truth.images]
    for image, view in zip(truth.images, recipe.views, strict=True):
        np.testing.assert_allclose(image.R_cw, view.R_cw, atol=1e-12)
        np.testing.assert_allclose(image.motion.phi, view.motion.phi, atol=1e-12)
    assert sorted(path.stem for path in (WALK / "global").iterdir()) == [
        Path(view.name).stem for view in recipe.references
    ]
    assert (WALK / "clip.mp4").stat().st_size <= 3e6


@pytest.mark.slow
def test_committed_clip_shows_what_its_recipe_renders(tmp_path):
    pytest.importorskip("av")
    recipe = load_recipe(WALK / "recipe.json")
    extract_frames(WALK / "clip.mp4", tmp_path / "frames", every=30)
    # a lower camera with the same K has the same first rows
    view = recipe.views[30]
    top = replace(recipe.cameras["1"], height=96)
    image = render_view(recipe.scene, top, view, **recipe.render_options)
    assert psnr(image, read_photo(tmp_path / "frames" / view.name).pixels[:96]) > 40


def test_true_motion_takes_the_shutter_out_of_the_walk(tmp_path):
    pytest.importorskip("av")
    recipe, truth = load_recipe(WALK / "recipe.json"), read_solution(WALK / "ground_truth.json")
    extract_frames(WALK / "clip.mp4", tmp_path / "frames", every=9)
    before, after = [], []
    for view in recipe.references[::3]:
        raw = read_photo(tmp_path / "frames" / view.name).pixels
        reference = read_photo((WALK / "global" / view.name).with_suffix(".jpg")).pixels
        depth = DepthMap(render_depth(recipe.scene, recipe.cameras["1"], view.at_once()))
        image = truth.image(view.name)
        motion = image.motion.in_camera(image.R_cw)
        rectified, mask = rectify(raw, truth.cameras["1"], motion, "constant-motion", depth=depth)
        after.append(psnr(rectified, reference, mask))
        before.append(psnr(raw, reference, mask))
    assert np.median(after) > 35
    assert np.median(before) < 30


def test_options_without_depth_leave_the_maps_out(tmp_path):
    pytest.importorskip("av")
    recipe = recipe_of(tmp_path, path={**PATH, "num_frames": 2, "way": WAY[:2]})
    simulate_scene(recipe, tmp_path / "out", SceneOptions(depth=False))
    assert not (tmp_path / "out" / "depth").exists()
