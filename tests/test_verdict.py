"""The verdict on solutions whose truth is known, from measurements by the NumPy projection."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, RowMotion, bundle_adjust
from rsundistort.bundle import choose_model
from rsundistort.critical import heal
from rsundistort.synthetic.measurements import measure
from rsundistort.verdict import judge, left_along_readout, left_over_frame, photo_motions

LENS = (-0.1, 0.03, 0.0, 0.0)
CAMERA = Camera(800, 600, [[700, 0, 402], [0, 700, 297], [0, 0, 1]], LENS)
NOISE_PX = 0.3

# problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def measured(rng, phi, *, num_points=250, noise_px=NOISE_PX, velocity=None):
    """Photos around a cloud, rolled at will, that turned by phi (m, 3) radians a frame; at the truth but for the noise."""
    m = len(phi)
    center_w = rng.normal(size=(m, 3))
    center_w *= 3.5 / np.linalg.norm(center_w, axis=1, keepdims=True)
    ahead = -center_w / np.linalg.norm(center_w, axis=1, keepdims=True)
    right = np.cross(ahead, rng.normal(size=(m, 3)))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R_cw = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    # fills the frame
    points_w = rng.uniform(-1.3, 1.3, (num_points, 3))
    phi = np.asarray(phi) / CAMERA.frame_span
    motions = [RowMotion(*each) for each in zip(phi, np.zeros((m, 3)) if velocity is None else velocity, strict=True)]
    point_idx, frame_idx = (each.ravel() for each in np.mgrid[:num_points, :m])
    seen = measure(
        points_w, R_cw, center_w, motions, [CAMERA] * m, frame_idx, point_idx,
        noise_px=noise_px, seed=int(rng.integers(1 << 30)),
    ).observations  # fmt: skip
    inside = ((seen.xy_raw >= 0) & (seen.xy_raw <= [799, 599])).all(1)
    rec = Reconstruction(
        [CAMERA], [f"{i}.jpg" for i in range(m)], np.zeros(m, int), R_cw, center_w, points_w, seen.select(inside)
    )
    return rec.with_points(np.ones(len(rec.observations), bool), min_track=3)


def still_and_swung(rng, m=8, sigma=0.02):
    """Motions of a hand, radians a frame."""
    return sigma * rng.normal(size=(m, 3))


def named(rec, model="rotation", options=None):
    """The verdict where a model is named."""
    options = options or BundleOptions()
    result, remedy = heal(bundle_adjust(rec, model, options), options)
    plain = bundle_adjust(result.reconstruction, "global", replace(options, outlier_rounds=0, sigma_px=result.sigma_px))
    return result, judge(result, plain, None, remedy)


def chosen(rec, options=None):
    """The verdict where evidence chooses the model, as a run does it."""
    options = options or BundleOptions()
    tried = bundle_adjust(rec, "rotation", options)
    choice = choose_model(
        tried.reconstruction, ("global", "two-step", "rotation"), options, sigma_px=tried.sigma_px
    )  # fmt: skip
    result, remedy = tried, None
    if choice.shutter_model != "rotation":
        result = bundle_adjust(tried.reconstruction, choice.shutter_model, options)
    if choice.shutter_model != "global":
        result, remedy = heal(result, options)
    return judge(result, None, choice, remedy, tried)
