"""The path of a video whose focal length is hardly known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from clips import HandHeld, filmed

from rsundistort import Camera
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, GuessedCameras, bundle_adjust
from rsundistort.bundle.path_prior import FramePath
from rsundistort.errors import ReconstructionError
from rsundistort.input.photo_cameras import GUESS_SIGMA
from rsundistort.solve import clip_lens, placing, video_path
from rsundistort.solve.clip_lens import at_first, is_other_lens, with_known_lens, with_unknown_lens
from rsundistort.solve.video_path import _new_points, _travelled
from rsundistort.verdict.judge_path import ReadoutTime

FRAME_S = 1 / 30


def first_adjustment(zoom=None, off=1.2):
    """The first adjustment of a path from a scene that was mapped by a focal length that is off; and the true one."""
    truth, times = filmed(HandHeld(5), 24, 0.6, **({} if zoom is None else {"zoom": zoom}))
    camera = truth.cameras[0]
    K = camera.K * [[off, 1, 1], [1, off, 1], [1, 1, 1]]
    wrong = replace(truth, cameras=[replace(camera, K=K)], variation=np.zeros((24, 3)))
    mapped = bundle_adjust(wrong, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    guessed = GuessedCameras(tuple(mapped.cameras), {"f": 0.2})
    options = BundleOptions(path=FramePath(times, FRAME_S), refine=("f", "cx", "cy", "k1"), guessed=guessed)
    return with_unknown_lens(mapped, at_first(options), StageLog(None)), camera


@pytest.mark.parametrize("off", [0.8, 1.25])
def test_a_wrong_focal_length_is_no_lens_that_varies(off):
    result, camera = first_adjustment(off=off)
    assert not is_other_lens(result, camera, 0.03)
    assert result.focal_sigma == 0.0


def test_a_lens_that_zooms_varies_where_its_focal_length_is_wrong_too():
    zoom = 1.0 + 0.1 * np.sin(np.arange(24) / 4.0)
    result, _ = first_adjustment(zoom)
    assert 0.03 < result.focal_sigma < 0.3
    assert np.corrcoef(result.reconstruction.variation[:, 0], zoom)[0, 1] > 0.8


def of_lens(f):
    return SimpleNamespace(cameras=[Camera(64, 48, np.diag([f, f, 1.0]))], num_images=8, image_names=())


CLIP = SimpleNamespace(frame_s=0.04, are_keys=lambda names: [True for _ in names])


@dataclass(frozen=True)
class Matches:
    """Matches of photos of some lens."""

    calibrated: bool
    cameras: object = None


@pytest.fixture
def clip_of(monkeypatch):
    """What `_travelled` maps, and the focal length that it ends with, by what paths find and how well they fit."""

    def clip_of(first_paths, last_paths, calibrated=False, maps=True):
        by, firsts, lasts = [], iter(first_paths), iter(last_paths)

        def map_again(matched, **_):
            if not maps:
                raise ReconstructionError("too few photos")
            by.append(matched.cameras[0].K[0, 0])
            return of_lens(by[-1])

        def path(f, sigma_px, readout_s=0.01):
            result = SimpleNamespace(reconstruction=of_lens(f), sigma_px=sigma_px, readout=ReadoutTime(readout_s, 1e-5))
            result.of_photos = lambda _: result
            return SimpleNamespace(clip=CLIP, result=result, options=None, filmed=None)

        monkeypatch.setattr(video_path, "map_key_frames", map_again)
        monkeypatch.setattr(video_path, "_first_path", lambda *_: path(*next(firsts)))

        def again(*_):
            last = next(lasts)
            if last is None:
                raise ReconstructionError("no points")
            return path(*last) if isinstance(last, tuple) else path(last, 0.1)

        monkeypatch.setattr(video_path, "_path_again", again)
        monkeypatch.setattr(clip_lens, "readout_of", lambda result: result.readout)
        monkeypatch.setattr(video_path, "read_num_verified", lambda _: {})
        monkeypatch.setattr(video_path, "share_that_fits", lambda *_: 1.0)
        placed = of_lens(500.0), Matches(calibrated)
        found = _travelled(CLIP, None, None, StageLog(None), None, lambda: placed)
        assert not [*firsts], "a path was not asked for"
        assert not [*lasts], "an adjustment was not asked for"
        return by, found.result.reconstruction.cameras[0].K[0, 0]

    return clip_of


GUESS = Camera(640, 360, [[447, 0, 319.5], [0, 447, 179.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("f", "k1", "believed"),
    [(520, -0.25, True), (800, 0.1, True), (2540, 9.0, False), (551, 1.05, False), (1300, 0.0, False)],
)
def test_a_lens_that_no_camera_has_is_not_what_key_frames_are_mapped_by(monkeypatch, f, k1, believed):
    """Mapping takes what the shutter bends for the lens's."""
    ways = []

    def mapped(matched, *_, **__):
        ways.append(matched.calibrated)
        lens = replace(GUESS, K=[[f, 0, 319.5], [0, f, 179.5], [0, 0, 1]], dist=[k1, 0, 0, 0])
        return SimpleNamespace(cameras=[GUESS if matched.calibrated else lens], num_images=8)

    monkeypatch.setattr(placing, "map_photos", mapped)
    monkeypatch.setattr(placing, "_num_fitting", lambda *_: 100)
    monkeypatch.setattr(placing, "consistent", lambda *_: True)
    matched, guessed = Matches(False, [GUESS]), GuessedCameras([GUESS], {**GUESS_SIGMA, "f": 0.28})
    found = placing.map_key_frames(matched, guessed=guessed).cameras[0]
    assert found.K[0, 0] == (f if believed else 447)
    assert ways == [False, False] if believed else [False, True, True]
    # one that is known, or was found by a path, is held anyway
    assert placing.map_key_frames(replace(matched, calibrated=True)).cameras[0] == GUESS


def test_a_lens_that_mapping_had_right_costs_nothing(clip_of):
    assert clip_of([(510.0, 0.2)], [511.0]) == ([], 511.0)


def test_a_scene_is_mapped_again_by_the_lens_of_its_path_until_that_stays(clip_of):
    assert clip_of([(400.0, 0.5), (360.0, 0.3), (355.0, 0.2)], [356.0]) == ([400.0, 360.0], 356.0)


def test_a_scene_that_fits_no_better_is_not_taken(clip_of):
    assert clip_of([(400.0, 0.5), (300.0, 0.5)], [401.0]) == ([400.0], 401.0)


def test_photos_that_cannot_be_mapped_again_keep_their_scene(clip_of):
    assert clip_of([(400.0, 0.5)], [401.0], maps=False) == ([], 401.0)


def test_the_last_adjustment_is_repeated_while_it_moves_the_lens_but_not_forever(clip_of):
    assert clip_of([(500.0, 0.2)], [470.0, 465.0])[1] == 465.0
    assert clip_of([(500.0, 0.2)], [470.0, 440.0, 410.0])[1] == 410.0
    # steps that grow shorter arrive, though points that are new leave more
    assert clip_of([(430.0, 0.2), (430.0, 0.2)], [(505.0, 0.1), (518.0, 0.104)])[1] == 518.0
    # so do those of a readout time, whatever the lens
    firsts, lasts = [(500.0, 0.2, 0.016)], [(500.0, 0.1, 0.019), (500.0, 0.11, 0.0199), (500.0, 0.11, 0.01995)]
    assert clip_of(firsts, lasts, calibrated=True)[1] == 500.0


@pytest.mark.parametrize("again", [(1230.0, 0.11), None], ids=["fits-less", "no-points"])
def test_a_last_adjustment_that_runs_away_is_not_taken(clip_of, again):
    assert clip_of([(500.0, 0.2)], [470.0, again])[1] == 470.0


def test_the_lens_of_a_camera_that_is_given_is_believed(clip_of):
    assert clip_of([(400.0, 0.5)], [350.0], calibrated=True) == ([], 350.0)


@pytest.mark.parametrize(
    ("focal_sigma", "varying_px", "steady_px", "varies"),
    [(1e-4, 0.3, None, True), (0.01, 0.3, 0.3, False), (0.01, 0.3, 0.4, True)],
)
def test_a_lens_that_is_known_varies_only_if_that_explains_the_frames(
    monkeypatch, focal_sigma, varying_px, steady_px, varies
):
    """Travel looks like zoom."""

    def adjusted(_, model, options, __):
        assert options.varying or steady_px is not None
        sizes = (focal_sigma, varying_px) if options.varying else (0.0, steady_px)
        return SimpleNamespace(focal_sigma=sizes[0], sigma_px=sizes[1])

    monkeypatch.setattr(clip_lens, "bundle_adjust", adjusted)
    found = with_known_lens(None, at_first(BundleOptions()), StageLog(None))
    assert (found.focal_sigma > 0) == varies


@pytest.mark.parametrize(("found", "asked"), [(500, [None]), (100, [None, 0.2]), (None, [None, 0.2])])
def test_points_of_frames_close_together_may_meet_at_small_angles(monkeypatch, found, asked):
    angles = []

    def made(*_, least_deg=None):
        angles.append(least_deg)
        if found is None and least_deg is None:
            raise ReconstructionError("no point")
        return SimpleNamespace(num_points=1000 if least_deg else found)

    monkeypatch.setattr(video_path, "retriangulate", made)
    assert _new_points(None, SimpleNamespace(num_points=1000)).num_points == (1000 if len(asked) > 1 else found)
    assert angles == asked
