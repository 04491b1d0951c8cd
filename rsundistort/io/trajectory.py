"""Camera poses as a trajectory, and points as a cloud, in the formats that every tool reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["write_point_cloud", "write_trajectory"]


def write_trajectory(
    path: Path, times: NDArray[np.float64], R_cw: NDArray[np.float64], center_w: NDArray[np.float64]
) -> None:
    """Write poses as TUM text, which `evo` reads: `timestamp tx ty tz qx qy qz qw` a line, by time.

    Parameters
    ----------
    path : Path
        File to write.
    times : (m,) array
        Timestamps.
    R_cw, center_w : (m, 3, 3), (m, 3) array
        Poses; written are those of the camera in the world, x right, y down, z ahead.
    """
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(np.reshape(R_cw, (-1, 3, 3)).transpose(0, 2, 1)).as_quat(canonical=True)
    table = np.column_stack([times, np.reshape(center_w, (-1, 3)), quaternions])
    order = np.argsort(times, kind="stable")
    with path.open("wb") as file:
        np.savetxt(file, table[order], fmt=["%.9f"] + 7 * ["%.12g"], header="timestamp tx ty tz qx qy qz qw")


def write_point_cloud(path: Path, points_w: NDArray[np.float64], rgb: NDArray[np.uint8] | None = None) -> None:
    """Write points (n, 3) and their colours (n, 3), black when left out, as binary PLY."""
    vertices = np.zeros(
        len(points_w), [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    for axis, name in enumerate("xyz"):
        vertices[name] = points_w[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = 0 if rgb is None else rgb[:, channel]
    properties = [f"property float {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header"]
    path.write_bytes("\n".join(header).encode() + b"\n" + vertices.tobytes())
