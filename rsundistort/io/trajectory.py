"""Camera poses as a trajectory, and points as a cloud, in the formats that every tool reads."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.array_types import Array
from ..model.path import CameraPath

__all__ = ["write_path", "write_point_cloud", "write_trajectory"]

_PATH_COLUMNS = ["frame", "time_s", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz"]


def write_trajectory(path: Path, times: Array, R_cw: Array, center_w: Array) -> None:
    """Write poses as TUM text, which `evo` reads: `timestamp tx ty tz qx qy qz qw` a line, by time.

    Parameters
    ----------
    times : (m,) array
        Timestamps.
    R_cw, center_w : (m, 3, 3), (m, 3) array
        Poses; written are those of the camera in the world, x right, y down, z ahead.
    """
    table = np.column_stack([times, np.reshape(center_w, (-1, 3)), _quaternions(R_cw)])
    order = np.argsort(times, kind="stable")
    with path.open("wb") as file:
        np.savetxt(file, table[order], fmt=["%.9f"] + 7 * ["%.12g"], header="timestamp tx ty tz qx qy qz qw")


def _quaternions(R_cw: Array) -> Array:
    """(m, 4) rotations x, y, z, w of cameras in the world."""
    from scipy.spatial.transform import Rotation

    rotated = np.reshape(R_cw, (-1, 3, 3)).transpose(0, 2, 1)
    return np.asarray(Rotation.from_matrix(rotated).as_quat(canonical=True))


def write_path(path: Path, names: Sequence[str], camera_path: CameraPath) -> None:
    """Write the path of a camera as CSV, a line for each frame: pose as in `write_trajectory`, velocity, rotation.

    Parameters
    ----------
    names : sequence of str, length m
        The frame of each moment.
    camera_path : CameraPath
        Written are its times in seconds, the camera in the world, its velocity in world units per second, and its
        angular velocity about its own axes (x right, y down, z ahead) in radians per second, which is minus
        `CameraPath.rate`: as the camera rotates, the world rotates the other way in it.
    """
    moved = np.column_stack(
        [camera_path.center_w, _quaternions(camera_path.R_cw), camera_path.velocity, -camera_path.rate]
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(_PATH_COLUMNS)
        for name, time_s, values in zip(names, camera_path.time_s.tolist(), (moved + 0.0).tolist(), strict=True):
            table.writerow([name, f"{time_s:.9f}", *(f"{each:.12g}" for each in values)])


def write_point_cloud(path: Path, points_w: Array, rgb: NDArray[np.uint8] | None = None) -> None:
    """Write points (n, 3) and their colours (n, 3), black when left out, as binary PLY."""
    rgb = np.zeros((len(points_w), 3), np.uint8) if rgb is None else rgb
    columns = dict(zip(("x", "y", "z", "red", "green", "blue"), (*points_w.T, *rgb.T), strict=True))
    vertices = np.zeros(len(points_w), [(name, "<f4" if name in "xyz" else "u1") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    properties = [f"property {'float' if name in 'xyz' else 'uchar'} {name}" for name in columns]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header"]
    path.write_bytes("\n".join(header).encode() + b"\n" + vertices.tobytes())
