"""Photos that a travelling camera explains as well as one that rotates: which one is chosen, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.bundle import BundleOptions, choose_model
from rsundistort.model.reprojection import shutter_displacements
from rsundistort.verdict.judge import _rival_reasons

CAMERA = Camera(768, 512, [[640, 0, 388], [0, 640, 251], [0, 0, 1]])
NOISE_PX = 0.05


def flight(rng, count, drift, rotation=0.003):
    """Nadir photos over ground of 5 m relief, 40 m below, of a camera that drifts across its readout and shakes."""
    points_w = np.column_stack([rng.uniform(-35, 35, (1500, 2)), rng.uniform(0, 5, 1500)])
    frames, points, xy, R_cw, center_w, phi, velocity = [], [], [], [], [], [], []
    for i in range(count):
        way = 1.0 if i % 2 else -1.0
        R = np.diag([way, -way, -1.0]) @ Rotation.from_rotvec(rng.normal(0, [0.04, 0.04, 0.1])).as_matrix()
        center = np.array([*rng.uniform(-8, 8, 2), 40 + rng.normal(0, 0.5)])
        travel = np.array([drift, 0.02, 0.0]) / CAMERA.frame_span
        motion = RowMotion(rng.normal(0, rotation, 3) / CAMERA.frame_span, travel)
        uv, valid = project_points((points_w - center) @ R.T, CAMERA, motion, "constant-motion")
        seen = np.flatnonzero(valid & (np.abs(uv - [384, 256]) < [384, 256]).all(1))
        frames.append(np.full(len(seen), i))
        points.append(seen)
        xy.append(uv[seen] + rng.normal(0, NOISE_PX, (len(seen), 2)))
        R_cw.append(R)
        center_w.append(center)
        phi.append(motion.phi)
        velocity.append(R.T @ travel)
    observed = Observations(np.concatenate(frames), np.concatenate(points), np.concatenate(xy))
    rec = Reconstruction(
        [CAMERA], [f"{i}.jpg" for i in range(count)], np.zeros(count, int), np.array(R_cw), np.array(center_w),
        points_w, observed, np.array(phi), np.array(velocity), shutter_model="constant-motion",
    )  # fmt: skip
    return rec.with_points(np.ones(len(observed), bool), min_track=3)


def at_rest(rec):
    return replace(rec, phi=np.zeros_like(rec.phi), velocity=np.zeros_like(rec.velocity), shutter_model="global")


def choose(rec):
    return choose_model(at_rest(rec), options=BundleOptions(), sigma_px=NOISE_PX)


def test_displacements_are_those_of_the_motions(rng):
    rec = flight(rng, 4, drift=0.5)
    moved, valid = shutter_displacements(rec)
    assert valid.all()
    # within half a frame 0.25 m at 35 to 40 m, that is 4 px and a little rotation
    assert 1.0 < np.median(np.linalg.norm(moved, axis=1)) < 4.0
    assert (shutter_displacements(at_rest(rec))[0] == 0).all()


@pytest.mark.parametrize("count", [4, 5, 8])
def test_a_drift_over_flat_ground_is_not_taken_for_rotations_in_silence(rng, count):
    choice = choose(flight(rng, count, drift=0.5))
    assert choice.shutter == "found"
    assert choice.shutter_model == "constant-motion" or _rival_reasons(choice)


def test_rotations_of_a_camera_that_stays_have_no_rival(rng):
    choice = choose(flight(rng, 8, drift=0.0, rotation=0.03))
    assert choice.shutter_model == "rotation"
    assert choice.rival < 0.2
    assert not _rival_reasons(choice)


def test_a_rival_is_a_reason_that_says_what_to_give(rng):
    choice = replace(choose(flight(rng, 5, drift=0.0, rotation=0.03)), rival=1.9)
    (said,) = _rival_reasons(choice)
    assert "1.9 times" in said
    assert "--model constant-motion" in said
