"""A clip without parallax: what its rotations explain stands in for a scene that cannot be triangulated, or is none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from clips import filmed
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, RunOptions
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import bundle_adjust
from rsundistort.bundle.path_prior import FramePath
from rsundistort.errors import InputError, ReconstructionError, RsUndistortWarning
from rsundistort.input import GyroOptions
from rsundistort.input.load import LoadedPhotos
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.io.gyro import GyroLog
from rsundistort.solve import video_path
from rsundistort.solve.clip_pan import as_directions
from rsundistort.solve.clip_verdict import FoundPath
from rsundistort.solve.run import solve_frames
from rsundistort.verdict.judge_path import ReadoutTime

PATH = FramePath({}, 1 / 30)
TURNED, TRAVELLED = "the path of a camera that only rotated", "the path through a scene"
CLIP = SimpleNamespace(names=["a", "b", "c"], time_s=np.arange(3) / 30, frame_s=1 / 30, part=np.zeros(3, int))


def keys_of(camera, specified=False):
    """Key frames of a camera."""
    cameras = PhotoCameras([camera], ["camera"], np.zeros(3, int), True, (specified,), "here")
    return LoadedPhotos(["a", "b", "c"], [], [], {}, cameras, {}, Path(), {}, 1.0)


@pytest.fixture
def solve(monkeypatch):
    """`solve_clip` of three frames, by what rotations, and a scene if there is one, say of them."""

    def solve(turned, explained, scene=None, filmed=None):
        def travelled(*_):
            if scene is None:
                raise ReconstructionError("no scene point could be triangulated")
            return FoundPath(CLIP, scene, BundleOptions(path=PATH), filmed)

        def hovered(*_):
            raise ReconstructionError("nor can what rotations leave")

        found = turned and FoundPath(CLIP, turned, BundleOptions(path=replace(PATH, rotation_only=True)))
        monkeypatch.setattr(video_path, "_only_rotated", lambda *_: (found, "by rotations" if explained else ""))
        monkeypatch.setattr(video_path, "_travelled", travelled)
        monkeypatch.setattr(video_path, "_hovered", hovered)
        return video_path.solve_clip(CLIP, keys_of(Camera(64, 36, np.eye(3))), PATH, None, None, StageLog(None))

    monkeypatch.setattr(video_path, "own_gyroscope", lambda _: None)
    monkeypatch.setattr(video_path, "readout_of", lambda _: ReadoutTime(0.01, 0.001))
    monkeypatch.setattr(video_path, "judged", lambda found, *_, **__: found.result)
    return solve


def test_a_camera_that_hardly_moves_has_no_scene(solve, monkeypatch):
    """Which is not even looked for."""
    stands = FoundPath(CLIP, TURNED, BundleOptions(path=replace(PATH, rotation_only=True)), stands=True)
    solve(None, explained=False, scene=TRAVELLED)
    monkeypatch.setattr(video_path, "_only_rotated", lambda *_: (stands, "by rotations"))
    monkeypatch.setattr(video_path, "_travelled", lambda *_: pytest.fail("a scene was looked for"))
    with pytest.warns(RsUndistortWarning, match="the camera hardly moves"):
        found = video_path.solve_clip(CLIP, keys_of(Camera(64, 36, np.eye(3))), PATH, None, None, StageLog(None))
    assert found == TURNED


class Still:
    """A camera on a tripod, that trembles by some degrees."""

    def __init__(self, size_deg):
        self.size = np.radians(size_deg)

    def rotations(self, time):
        angle = np.sin(np.outer(np.asarray(time), [7.0, 11.0, 5.0]))
        return Rotation.from_rotvec(self.size * angle).as_matrix()

    def centers(self, time):
        return np.zeros((*np.shape(time), 3))

    seed = 4


@pytest.mark.parametrize(("size_deg", "stands"), [(0.0, True), (0.02, True), (2.0, False)])
def test_the_lens_of_a_camera_that_hardly_moves_stays_as_it_is_guessed(monkeypatch, size_deg, stands):
    """Errors of the flow would say anything of it."""
    seen, time_s = filmed(Still(size_deg), noise_px=0.1)
    guess = Camera(640, 480, [[650, 0, 319.5], [0, 650, 239.5], [0, 0, 1]])
    said = replace(guess, K=[[520, 0, 319.5], [0, 520, 239.5], [0, 0, 1]])
    start = as_directions(seen, replace(seen, cameras=[said]))
    monkeypatch.setattr(video_path, "rotating_only", lambda *_: start)
    clip = SimpleNamespace(
        names=seen.image_names, time_s=np.arange(30) / 30, frame_s=1 / 30, part=np.zeros(30, int), is_even=True,
        places=lambda names: np.array([int(name[:6]) for name in names]),
    )  # fmt: skip
    cameras = PhotoCameras([guess], ["camera"], np.zeros(30, int), False, (True,), "guessed", (), [{"f": 0.28}], [0])
    keys = LoadedPhotos(list(seen.image_names), [], [], {}, cameras, {}, Path(), {}, 1.0)

    def options_of(_):
        return BundleOptions(refine=("f", "k1"), guessed=cameras.known_to(loose=True))

    monkeypatch.setattr(video_path, "with_gaps", lambda clip, path, *_: (clip, path))
    path = FramePath(time_s, 1 / 30)
    found, explained = video_path._only_rotated(clip, keys, path, options_of, StageLog(None))
    assert (found.stands, explained) == (stands, "by rotations")
    camera = found.result.reconstruction.cameras[0]
    if stands:
        assert camera == guess
    else:
        assert abs(camera.K[0, 0] - 500) < 10


@pytest.mark.parametrize("explained", [True, False], ids=["all frames", "neighbours alone"])
def test_rotations_stand_in_for_a_scene(solve, explained):
    with pytest.warns(RsUndistortWarning, match="only rotated: without parallax there are directions"):
        assert solve(TURNED, explained) == TURNED


def test_the_clock_of_a_log_is_looked_for_around_the_offset_that_is_given(solve, monkeypatch):
    class Sought(Exception):
        pass

    def felt(_, log, around_s):
        raise Sought(f"{log.time_s[0]:g} {around_s:g}")

    assert solve(None, False, TRAVELLED) == TRAVELLED  # what frames say holds for those of the next call, too
    monkeypatch.setattr(video_path, "felt_gyroscope", felt)
    options, keys = RunOptions(gyro=GyroOptions("log.csv", 70.0)), keys_of(Camera(64, 36, np.eye(3)))
    with pytest.raises(Sought, match="71 70"):
        solve_frames(options, CLIP, keys, [], GyroLog([71.0, 72.0], np.ones((2, 3))), StageLog(None))


def test_a_camera_that_is_to_rotate_only_has_no_scene(solve, monkeypatch):
    with pytest.warns(RsUndistortWarning, match="only rotated"):
        solve(TURNED, explained=True)
    monkeypatch.setattr(video_path, "_travelled", lambda *_: pytest.fail("a scene was looked for"))
    keys = keys_of(Camera(64, 36, np.eye(3)))
    with pytest.warns(RsUndistortWarning, match="only rotated"):
        assert video_path.solve_clip(CLIP, keys, PATH, None, None, StageLog(None), rotates=True) == TURNED
    monkeypatch.setattr(video_path, "_only_rotated", lambda *_: (None, ""))
    with pytest.raises(ReconstructionError, match="rotations do not explain the frames"):
        video_path.solve_clip(CLIP, keys, PATH, None, None, StageLog(None), rotates=True)


def test_without_them_the_error_says_what_is_missing(solve):
    with pytest.raises(ReconstructionError, match="no scene point"):
        solve(None, explained=False)


STABILISED = SimpleNamespace(verdict="stabilised")


@pytest.mark.parametrize("why", ["stabilised", "no readout"])
def test_a_scene_that_shows_no_readout_is_none_if_rotations_show_one(solve, monkeypatch, why):
    """As of passers-by, before a camera on a tripod."""
    scene = TRAVELLED + " of things that move"
    shown = {TURNED: ReadoutTime(0.01, 0.001), scene: ReadoutTime(0.02, 0.001 if why == "stabilised" else 0.01)}
    monkeypatch.setattr(video_path, "readout_of", shown.__getitem__)
    with pytest.warns(RsUndistortWarning, match="only rotated"):
        assert solve(TURNED, False, scene, STABILISED if why == "stabilised" else None) == TURNED
    # neither shows any: the scene stays
    shown[TURNED] = ReadoutTime(0.01, 0.01)
    assert solve(TURNED, False, scene, STABILISED if why == "stabilised" else None) == scene


def test_a_scene_that_shows_a_readout_stays(solve):
    assert solve(TURNED, False, TRAVELLED) == TRAVELLED


ROUGH, EXACT = ReadoutTime(0.02, 3e-3), ReadoutTime(0.01, 1e-4)
UPRIGHT, LYING = Camera(36, 64, np.eye(3)), Camera(64, 36, np.eye(3))
NOTHING = ReadoutTime(0.01, 0.01)


@pytest.mark.parametrize(
    ("camera", "specified", "by_direction", "expected"),
    [
        # sensors lie on their long side
        (UPRIGHT, False, {"left-to-right": (EXACT, 0.1)}, "left-to-right"),
        (UPRIGHT, False, {"left-to-right": (ReadoutTime(-0.02, 1e-4), 0.1), "right-to-left": (NOTHING, 0.1)},
         "right-to-left"),
        # a part of a frame that lay
        (UPRIGHT, False, {"left-to-right": (NOTHING, 0.1), "top-to-bottom": (EXACT, 0.1)}, "top-to-bottom"),
        (UPRIGHT, False, {"left-to-right": (ROUGH, 0.2), "top-to-bottom": (EXACT, 0.1)}, "top-to-bottom"),
        (UPRIGHT, False, {"left-to-right": (ROUGH, 0.1), "top-to-bottom": (EXACT, 0.2)}, "left-to-right"),
        (UPRIGHT, False, {"left-to-right": (NOTHING, 0.1), "top-to-bottom": (NOTHING, 0.1)}, "left-to-right"),
        (UPRIGHT, False, {"left-to-right": None, "top-to-bottom": (NOTHING, 0.1)}, "top-to-bottom"),
        # what is specified, and frames that lie, are not asked
        (UPRIGHT, True, {"top-to-bottom": (NOTHING, 0.1)}, "top-to-bottom"),
        (LYING, False, {"top-to-bottom": (NOTHING, 0.1)}, "top-to-bottom"),
    ],
)  # fmt: skip
def test_the_lines_of_frames_that_stand_are_those_that_fit(monkeypatch, camera, specified, by_direction, expected):
    def filmed(clip, keys, *_, **__):
        found = by_direction[keys.cameras.of(0).readout]
        if found is None:
            raise InputError("it does not fit at all")
        return FoundPath(CLIP, SimpleNamespace(time=found[0], sigma_px=found[1]), BundleOptions(path=PATH))

    monkeypatch.setattr(video_path, "_filmed_by", filmed)
    monkeypatch.setattr(video_path, "own_gyroscope", lambda _: None)
    monkeypatch.setattr(video_path, "readout_of", lambda result: result.time)
    monkeypatch.setattr(video_path, "judged", lambda found, keys, *_, **__: keys.cameras.of(0).readout)
    found = video_path.solve_clip(CLIP, keys_of(camera, specified), PATH, None, None, StageLog(None))
    assert found == expected


def test_frames_that_fit_along_no_axis_say_why(monkeypatch):
    def filmed(*_, **__):
        raise ReconstructionError("no scene point could be triangulated")

    monkeypatch.setattr(video_path, "_filmed_by", filmed)
    monkeypatch.setattr(video_path, "own_gyroscope", lambda _: None)
    with pytest.raises(ReconstructionError, match="no scene point"):
        video_path.solve_clip(CLIP, keys_of(UPRIGHT), PATH, None, None, StageLog(None))


@pytest.mark.parametrize(("by_zoom_px", "by_travel_px", "expected"), [(0.1, 0.2, TURNED), (0.2, 0.1, TRAVELLED)])
def test_a_zoom_that_travel_explains_better_is_none(monkeypatch, by_zoom_px, by_travel_px, expected):
    def found(what, sigma_px):
        return FoundPath(CLIP, SimpleNamespace(what=what, sigma_px=sigma_px), BundleOptions(path=PATH))

    monkeypatch.setattr(video_path, "_only_rotated", lambda *_: (found(TURNED, by_zoom_px), "by zooming"))
    monkeypatch.setattr(video_path, "_travelled", lambda *_: found(TRAVELLED, by_travel_px))
    monkeypatch.setattr(video_path, "readout_of", lambda _: ReadoutTime(0.01, 0.001))
    keys = keys_of(Camera(64, 36, np.eye(3)))
    chosen = video_path._filmed_by(CLIP, keys, PATH, None, StageLog(None), None, lambda: (None, None))
    assert chosen.result.what == expected


@dataclass(frozen=True)
class Arm:
    """A camera that is swung about an axis behind it."""

    length: float
    seed: int = 3

    def rotations(self, time):
        angle = np.sin(np.asarray(time) * 2.0) - 0.5
        return Rotation.from_rotvec(0.5 * angle[:, None] * [0.0, -1.0, 0.0]).as_matrix()

    def centers(self, time):
        return self.length * self.rotations(time)[:, 2]


@pytest.mark.parametrize("length", [0.0, 0.1], ids=["on-a-tripod", "swung-on-an-arm"])
def test_frames_far_apart_show_whether_a_camera_that_rotates_travels(length):
    """Those of neighbours hide the travel of a camera on an arm, which looks like a longer focal length."""
    seen, time_s = filmed(Arm(length), noise_px=0.1)
    path = FramePath(time_s, 1 / 30, rotation_only=True)
    options, standing = BundleOptions(path=path, refine=("f",)), np.zeros_like(seen.center_w)
    rotated = bundle_adjust(as_directions(seen, replace(seen, center_w=standing)), "constant-motion", options)
    turned = FoundPath(CLIP, rotated, options)
    found = FoundPath(CLIP, SimpleNamespace(reconstruction=seen, sigma_px=0.1), options)
    left_px = video_path._left_by_rotations(found, turned, StageLog(None))
    assert left_px > 0.25 if length else left_px < 0.18
    # a few frames say nothing of the others
    few = seen.take_photos(np.arange(seen.num_images) < 12)
    found = replace(found, result=SimpleNamespace(reconstruction=few, sigma_px=0.1))
    assert video_path._left_by_rotations(found, turned, StageLog(None)) == 0.0


@pytest.mark.parametrize("plausible", [True, False])
def test_a_scene_that_shows_travel_takes_the_place_of_rotations(solve, monkeypatch, plausible):
    """A lens that is none makes no scene; then rotations are doubtful."""

    def check(*_):
        if not plausible:
            raise ReconstructionError("no such lens")

    monkeypatch.setattr(PhotoCameras, "check_plausible", check)
    turned, scene = (SimpleNamespace(reconstruction=SimpleNamespace(cameras=[]), sigma_px=0.1) for _ in range(2))
    monkeypatch.setattr(video_path, "judged", lambda found, *_, **__: (found.result, found.travel_px))
    monkeypatch.setattr(video_path, "_left_px", lambda _: 0.1)
    monkeypatch.setattr(video_path, "_left_by_rotations", lambda *_: 0.15)
    with pytest.warns(RsUndistortWarning, match="only rotated"):
        assert solve(turned, True, scene) == (turned, 0.0)
    monkeypatch.setattr(video_path, "_left_by_rotations", lambda *_: 0.3)
    if plausible:
        assert solve(turned, True, scene) == (scene, 0.0)
    else:
        with pytest.warns(RsUndistortWarning, match="travelled too little"):
            assert solve(turned, True, scene) == (turned, 0.3)


@dataclass(frozen=True)
class Drone:
    """A drone that yaws above ground that it looks at slantwise, and hovers more or less in one place."""

    hovers: float
    seed: int = 6

    def rotations(self, time):
        t = np.asarray(time)
        wobble = 0.004 * np.stack([np.sin(9 * t), 3 * np.sin(2.2 * t) + 60 * t, np.sin(12 * t)], axis=1)
        return Rotation.from_rotvec(wobble).as_matrix()

    def centers(self, time):
        t = np.asarray(time)
        return self.hovers * np.stack([np.sin(5 * t), np.cos(7 * t + 1), np.sin(8 * t)], axis=1)


def slanted(hand):
    """What it sees, its directions as of one place, and the times of its frames."""
    seen, time_s = filmed(hand, num_points=300, noise_px=0.1)
    standing = as_directions(seen, replace(seen, center_w=np.zeros_like(seen.center_w)))
    path = FramePath(time_s, 1 / 30, rotation_only=True)
    options = BundleOptions(path=path)
    return FoundPath(CLIP, bundle_adjust(standing, "constant-motion", options), options)


def test_parallax_that_looks_like_a_readout_is_a_scene(monkeypatch):
    """Too little to map it, and enough to tell depths."""
    rotated = slanted(Drone(0.01))
    true_s = 0.6 / 30
    found = video_path._hovered(rotated, StageLog(None))
    time_s, sigma_s = (float(each[0]) for each in (found.result.path.readout_s, found.result.path.sigma_readout_s))
    assert abs(time_s - true_s) < 3 * sigma_s < 0.1 * true_s
    assert abs(rotated.result.path.unbounded_s[0] - true_s) > 5 * abs(time_s - true_s)
    assert found.result.sigma_px < 0.12
    assert not found.path.rotation_only
    assert np.ptp(found.result.reconstruction.center_w, axis=0).max() > 1e-3

    # it takes the place of rotations by as much as any scene has to
    def nothing(*_):
        raise ReconstructionError("no scene point could be triangulated")

    monkeypatch.setattr(video_path, "_travelled", nothing)
    keys = keys_of(Camera(64, 36, np.eye(3)))
    for hand, is_scene in ((rotated, True), (slanted(Drone(0.0)), False)):
        monkeypatch.setattr(video_path, "_only_rotated", lambda *_, found=hand: (found, "by rotations"))
        chosen = video_path._filmed_by(CLIP, keys, PATH, None, StageLog(None), None, lambda: (None, None))
        assert chosen.path.rotation_only is not is_scene
