"""Cameras that shake faster than the frames of their video show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from clips import HandHeld, filmed

from rsundistort import BundleOptions, Reconstruction, RsUndistortWarning, bundle_adjust
from rsundistort.bundle import BundleResult
from rsundistort.bundle.own_motions import own_motions
from rsundistort.bundle.path_prior import FramePath, PathStart
from rsundistort.input.key_frames import Clip
from rsundistort.solve import shaking
from rsundistort.solve.shaking import held_by_slow_rotations, speeds_of, tell_if_held, with_slow_rotations
from rsundistort.verdict.speeds import BySpeed, ReadoutTime

NUM = 40


def clip_of(rec: Reconstruction, times: dict[str, float], frame_s: float) -> Clip:
    """The clip of a reconstruction, as far as its times go."""
    n = len(times)
    return Clip(
        Path("clip.mp4"), Path(), tuple(range(n)), tuple(times), np.array([*times.values()]), frame_s,
        np.zeros(n, np.int64), np.arange(n), None,
    )  # fmt: skip


def adjusted(start: Reconstruction, path: FramePath) -> BundleResult:
    options = BundleOptions(path=path, outlier_rounds=0, deviations="model")
    return bundle_adjust(start, "constant-motion", options)


@pytest.mark.parametrize("seed", [1, 4])
def test_a_path_of_few_frames_is_held_at_the_readout_time_of_slow_rotations(seed: int) -> None:
    """A hand that trembles at 5 to 11 Hz, with 15 frames a second: its path is off by many standard deviations."""
    true_s = 0.35 / 15
    truth, times = filmed(HandHeld(seed, tremor=0.015), NUM, 0.35, noise_px=0.1, frame_s=1 / 15)
    clip, path = clip_of(truth, times, 1 / 15), FramePath(times, 1 / 15)
    plain = bundle_adjust(truth, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    free = adjusted(plain, path)
    rec = free.reconstruction
    assert free.path.readout_s[0] > 1.04 * true_s

    held = held_by_slow_rotations(clip, rec, path, own_motions(rec))
    assert held.held_sigma > 0
    start = PathStart(tuple(rec.image_names), free.path.state, free.path_sigmas)
    again = adjusted(rec, replace(held, start=start))
    assert again.path.readout_s[0] == pytest.approx(held.readout[0], rel=1e-3)
    assert again.path.sigma_readout_s[0] == pytest.approx(held.held_sigma, rel=1e-2)
    speeds = speeds_of(clip, again.reconstruction, own_motions(again.reconstruction), again.path.readout_s[0])
    found = with_slow_rotations(again, held, speeds).path
    assert abs(found.readout_s[0] - true_s) < max(3 * found.sigma_readout_s[0], 0.02 * true_s)
    assert abs(found.readout_s[0] - true_s) < 0.5 * abs(free.path.readout_s[0] - true_s)
    with pytest.warns(RsUndistortWarning, match="shakes faster than half of the frame rate"):
        tell_if_held(held)

    # what is known otherwise counts beside them
    known = held_by_slow_rotations(clip, rec, replace(path, readout=(true_s, 1e-5)), own_motions(rec))
    assert known.readout[0] == pytest.approx(true_s, rel=1e-2)
    assert known.held_sigma < 1.01e-5


def test_a_path_that_follows_its_camera_is_free() -> None:
    truth, times = filmed(HandHeld(1), NUM, noise_px=0.1)
    path = FramePath(times, 1 / 30)
    plain = bundle_adjust(truth, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    result = adjusted(plain, path)
    rec, clip = result.reconstruction, clip_of(truth, times, 1 / 30)
    own = own_motions(rec)
    assert held_by_slow_rotations(clip, rec, path, own) is path
    speeds = speeds_of(clip, rec, own, 0.02)
    assert speeds.unfollowed < 0.01
    assert with_slow_rotations(result, path, speeds) is result
    for each in (speeds.slow, speeds.fast):
        assert abs(each.seconds - 0.02) < max(3 * each.sigma, 2e-4)
    # too few frames say nothing
    few = rec.take_photos(np.arange(NUM) < 20)
    assert held_by_slow_rotations(clip, few, path, own_motions(few)) is path


@pytest.mark.parametrize(("size_px", "held"), [(0.05, False), (0.5, True)])
def test_what_lens_and_scene_leave_is_no_shaking(monkeypatch, size_px, held):
    f = 500.0
    rec = SimpleNamespace(cameras=[SimpleNamespace(K=np.diag([f, f, 1.0]))])
    said = BySpeed(ReadoutTime(0.02, 1e-3), None, 0.5, size_px / f)
    monkeypatch.setattr(shaking, "speeds_of", lambda *_, **__: said)
    path = FramePath({"a": 0.0, "b": 1 / 30}, 1 / 30)
    assert bool(held_by_slow_rotations(None, rec, path, None).held_sigma) == held


@pytest.mark.parametrize(("known", "held"), [((0.021, 4e-4), True), ((0.030, 6e-4), False)])
def test_slow_rotations_that_contradict_a_known_readout_time_hold_nothing(monkeypatch, known, held):
    rec = SimpleNamespace(cameras=[SimpleNamespace(K=np.diag([500.0, 500.0, 1.0]))])
    said = BySpeed(ReadoutTime(0.02, 1e-3), None, 0.5, 1e-3)
    monkeypatch.setattr(shaking, "speeds_of", lambda *_, **__: said)
    path = FramePath({"a": 0.0, "b": 1 / 30}, 1 / 30, known)
    assert bool(held_by_slow_rotations(None, rec, path, None).held_sigma) == held
