"""The edge of the library: whatever is handed to a public function, it answers rightly or says what was expected."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from dataclasses import is_dataclass

import numpy as np
import pytest

import rsundistort as rs
from rsundistort import evaluation
from rsundistort.errors import RsUndistortError

CAMERA = rs.Camera(40, 30, [[35.0, 0, 19.5], [0, 35.0, 14.5], [0, 0, 1]], [0.05, 0, 0, 0])
MOTION = rs.RowMotion([0.02, 0.01, -0.01])
OBSERVATIONS = rs.Observations([0, 1, 0, 1], [0, 0, 1, 1], np.full((4, 2), 5.0))
POSES = {"R_cw": np.tile(np.eye(3), (2, 1, 1)), "center_w": [[0.0, 0, 0], [1.0, 0, 0]]}
POINTS = [[0.0, 0.0, 4.0], [1.0, 0.0, 5.0]]
SOLVED = {"name": "a.jpg", "camera_id": "1", "R_cw": np.eye(3), "center_w": np.zeros(3), "motion": rs.RowMotion()}
RECONSTRUCTION = {
    "cameras": [CAMERA], "image_names": ["a", "b"], "camera_idx": [0, 0], **POSES, "points_w": POINTS,
    "observations": OBSERVATIONS, "phi": np.zeros((2, 3)), "velocity": np.zeros((2, 3)), "variation": np.zeros((2, 3)),
}  # fmt: skip
PHOTO = np.full((30, 40, 3), 90, np.uint8)
SOLUTION = rs.Solution("rotation", {"1": CAMERA}, {"1": CAMERA.pinhole()}, [rs.SolvedImage(**SOLVED)])

#: A right call of what takes arrays; the walk below puts something else in the place of each argument.
CALLS: dict[str, dict[str, object]] = {
    "AtInfinity": {},
    "BundleOptions": {},
    "Camera": {"width": 40, "height": 30, "K": CAMERA.K, "dist": np.zeros(5), "field": np.zeros((4, 4, 2))},
    "DepthMap": {"depth": np.ones((30, 40)), "size": (40, 30)},
    "GyroOptions": {"file": "log.csv"},
    "KnownLength": {"start": ("a", 1.0, 2.0), "end": ("b", 3.0, 4.0), "length": 2.0, "sigma": 0.1},
    "Observations": {"frame_idx": [0, 1], "point_idx": [0, 0], "xy_raw": np.ones((2, 2)), "sigma": np.ones(2)},
    "Plane": {"normal": [0.0, 0.0, 1.0], "distance": 3.0},
    "Reconstruction": RECONSTRUCTION,
    "RectifyOptions": {},
    "RemapGrid": {
        "map_x": np.ones((30, 40)), "map_y": np.ones((30, 40)), "source_width": 40, "source_height": 30,
    },
    "RowMotion": {"phi": np.zeros(3), "velocity": np.zeros(3), "bend": None, "frame": "camera"},
    "RunOptions": {},
    "Solution": {
        "shutter_model": "rotation", "cameras": {"1": CAMERA}, "rectified_cameras": {"1": CAMERA.pinhole()},
        "images": [rs.SolvedImage(**SOLVED)],
    },
    "SolveOptions": {},
    "SolvedImage": SOLVED,
    "ViewOptions": {"alpha": 0.5, "scale": 1.0, "max_size": 100},
    "critical_motion": {"R_cw": np.tile(np.eye(3), (4, 1, 1)), "center_w": np.eye(4, 3), "readout": "top-to-bottom"},
    "distort_points": {"points": np.full((3, 2), 9.0), "camera": CAMERA, "motion": None, "R": np.eye(3), "P": CAMERA.K},
    "init_rectify_map": {"camera": CAMERA, "motion": MOTION, "R": np.eye(3), "new_K": CAMERA.K, "size": (40, 30)},
    "largest_shift_px": {"camera": CAMERA, "motion": MOTION, "shutter_model": "rotation"},
    "optimal_new_camera": {"camera": CAMERA, "motion": MOTION, "alpha": 0.5, "size": (40, 30)},
    "project_points": {"points_c": POINTS, "camera": CAMERA, "motion": None, "shutter_model": "rotation"},
    "rectify": {"photo": PHOTO, "camera": CAMERA, "motion": None, "interpolation": "linear", "mask": None, "jobs": 1},
    "undistort_points": {"points": np.full((3, 2), 9.0), "camera": CAMERA, "depth": np.ones(3), "P": CAMERA.K},
    "unproject_points": {"xy_raw": np.full((3, 2), 9.0), "camera": CAMERA, "motion": MOTION},
}  # fmt: skip
# Of public modules.
FURTHER: dict[str, Callable[..., object]] = {
    "psnr": evaluation.psnr, "pose_at": MOTION.pose_at, "at": MOTION.at, "of": rs.RowMotion.of, "in_camera":
    rs.RowMotion([0.0, 0, 0], [1.0, 0, 0]).in_camera, "apply": rs.RemapGrid.from_camera(CAMERA, MOTION).apply,
    "inverse_depth": rs.Plane([0.0, 0, 1.0], 3.0).inverse_depth,
}  # fmt: skip
CALLS |= {
    "psnr": {"image": PHOTO, "truth": PHOTO, "mask": PHOTO[..., 0].copy(), "margin_px": 2},
    "pose_at": {"clock": 0.1, "R_cw": np.eye(3), "center_w": np.zeros(3)},
    "at": {"clock": np.zeros(5)},
    "of": {"clock": np.linspace(0, 1, 20), "rotation": np.zeros((20, 3)), "position": np.zeros((20, 3)), "sites": 9},
    "in_camera": {"R_cw": np.eye(3)},
    "apply": {"image": PHOTO, "interpolation": "linear", "jobs": 1},
    "inverse_depth": {"rays": np.ones((4, 3))},
}  # fmt: skip
# What takes folders or files, and the errors and warnings.
WITHOUT = {
    "RsUndistortError", "RsUndistortWarning", "analyze", "bundle_adjust", "evaluate", "read_solution", "rectify_folder",
    "run", "solve", "write_solution",
}  # fmt: skip

ODD: dict[str, object] = {
    "nothing": None,
    "a text": "x",
    "a number as text": "1.5",
    "bytes": b"x",
    "a number": 3.5,
    "zero": 0,
    "a negative number": -1,
    "a huge number": 10**30,
    "infinity": float("inf"),
    "no number": float("nan"),
    "true": True,
    "an object": object(),
    "an empty list": [],
    "a dict": {"a": 1},
    "ragged": [[1, 2], [3]],
    "texts": ["a", "b"],
    "numbers as texts": [["1", "2", "3"]],
    "no values": [None, None, None],
    "complex": np.ones(3) * 1j,
    "complex pairs": np.ones((3, 2)) + 1j,
    "of no dimension": np.array(1.0),
    "of five dimensions": np.zeros((1, 1, 1, 1, 1)),
    "empty": np.zeros((0, 2)),
    "empty rows": np.zeros((3, 0)),
    "NaN": np.full((3, 2), np.nan),
    "NaN vector": np.full(3, np.nan),
    "infinities": np.full((3, 2), np.inf),
    "NaN matrix": np.full((3, 3), np.nan),
    "zeros": np.zeros((3, 3)),
    "objects": np.array([object()] * 3),
    "dates": np.array(["2020-01-01"], "M8[D]"),
    "records": np.zeros(3, [("a", "f8")]),
    "bools": np.ones((30, 40), bool),
    "many channels": np.zeros((30, 40, 600), np.uint8),
    "two channels": np.zeros((30, 40, 2), np.float32),
    "doubles": np.zeros((30, 40)),
    "another photo": np.zeros((29, 40, 3), np.uint8),
    "no pixels": np.zeros((0, 0, 3), np.uint8),
    "a function": len,
}


def test_every_public_name_is_walked():
    assert set(CALLS) - set(FURTHER) | WITHOUT == set(rs.__all__)
    for name, arguments in CALLS.items():
        assert set(arguments) <= set(inspect.signature(FURTHER.get(name) or getattr(rs, name)).parameters)


def finite_or_marked(result: object) -> None:
    """Numbers are numbers: NaN only where points have no place, which NaN alone shows."""
    if isinstance(result, tuple) and isinstance(result[-1], np.ndarray) and result[-1].dtype.kind == "b":
        values, valid = result
        assert np.isfinite(values[valid]).all()


def answered_or_refused(name: str, function: Callable[..., object], arguments: dict[str, object], label: str) -> None:
    try:
        result = function(**arguments)
    except RsUndistortError as refused:
        said = str(refused)
    except Exception as error:
        raise AssertionError(f"{name}({label}): {type(error).__name__}: {error}") from error
    else:
        finite_or_marked(result)
        return
    assert 0 < len(said) < 500, label
    assert "\n" not in said, label


@pytest.mark.parametrize(
    ("name", "argument"), [(name, each) for name, arguments in CALLS.items() for each in arguments]
)
def test_whatever_is_handed_in_is_refused_in_one_line_or_answered(name, argument):
    function = FURTHER.get(name) or getattr(rs, name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        function(**CALLS[name])
        for label, odd in ODD.items():
            answered_or_refused(name, function, {**CALLS[name], argument: odd}, f"{argument}={label}")


@pytest.mark.parametrize("name", [name for name in rs.__all__ if is_dataclass(getattr(rs, name))])
def test_every_option_is_checked_when_it_is_given(name):
    made, simple = getattr(rs, name), inspect.signature(getattr(rs, name)).parameters.keys() - CALLS[name].keys()
    for argument in sorted(simple):
        for label in ("an object", "complex", "many channels", "no values", "a huge number", "no number", "bytes"):
            answered_or_refused(name, made, {**CALLS[name], argument: ODD[label]}, f"{argument}={label}")
