"""Stabilised clips against clips as the sensor saw them, by motions of frames and a gyroscope of unknown axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clips import HandHeld, filmed

from rsundistort import bundle_adjust
from rsundistort.bundle import BundleOptions
from rsundistort.bundle.own_motions import own_motions
from rsundistort.input.stabilisation import calmer_than_felt, judge_stabilisation
from rsundistort.io import GyroLog
from rsundistort.solve.clip_gyroscope import rotations_between

FRAME_S = 1 / 30


def said(found, time_s, frame_span):
    pairs, turns = rotations_between(np.zeros(len(time_s), np.int64), found.R_cw)
    sigma = np.linalg.norm(found.sigma_rotation[pairs], axis=1)
    phi, of_phi = found.phi * frame_span, found.sigma_phi * frame_span
    return judge_stabilisation(time_s, pairs, turns, phi, of_phi, rotation_sigma=sigma)


@pytest.mark.parametrize("seed", [11, 12])
def test_frames_that_were_rotated_back_are_named_and_others_are_not(seed):
    """From a start that knows no shutter, as videos have it."""
    truth, times = filmed(HandHeld(seed), 40, noise_px=0.2)
    start = bundle_adjust(truth, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    span, time_s = truth.frame_span()[0], np.array([*times.values()])
    found = own_motions(start)
    assert said(found, time_s, span).verdict == "none"
    # rotated back as a whole, the frames look on without rotating, and their lines show the shaking all the same
    still = replace(found, R_cw=np.tile(found.R_cw[:1], (40, 1, 1)))
    assert said(still, time_s, span).verdict == "stabilised"


def shaking(time_s):
    phase = np.outer(time_s, [19.0, 26.0, 31.0])
    return np.stack([0.3 * np.sin(phase[:, k]) for k in range(3)], axis=1)


@pytest.mark.parametrize(("left", "named"), [(1.0, False), (0.8, False), (0.1, True)])
def test_a_gyroscope_of_any_axes_and_bias_names_frames_that_rotate_too_little(left, named):
    """With a sensor that lies otherwise, a clock that is off by three frames, and a focal length that is wrong."""
    time_s = np.arange(90) * FRAME_S
    pairs = np.column_stack([np.arange(89), np.arange(1, 90)])
    at = np.arange(-0.5, 3.6, 0.005)
    felt = GyroLog(at + 0.1, shaking(at)[:, [2, 0, 1]] * [1, -1, 1] + [0.05, 0.0, -0.02])
    turns = -left * GyroLog(at, shaking(at)).mean(time_s[:-1], time_s[1:]) * FRAME_S
    turns += np.random.default_rng(0).normal(0, 1e-4, turns.shape)
    said = calmer_than_felt(time_s, pairs, turns, 1e-4, felt)
    assert bool(said) is named
    calm = GyroLog(at, 1e-3 * shaking(at))
    assert not calmer_than_felt(time_s, pairs, 1e-3 * turns, 1e-4, calm)
