"""Content of a report beyond `solution.json`: residuals and the global-shutter result, small enough to keep."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bundle import BundleResult
from ..errors import FormatError, format_errors
from ..evaluation import align_points
from ..io.aside import write_aside
from ..model import Reconstruction
from ..model.array_types import Array, Index
from ..model.arrays import read_arrays
from ..model.reprojection import reprojection_residuals

__all__ = ["Diagnostics", "read_diagnostics", "write_diagnostics"]

_FORMAT = "rsundistort-report"
_VERSION = 1

# Types of the arrays, and the number of axes where the shape depends on them; the others are floats.
_KINDS: dict[str, tuple[str, int | None]] = {
    "names": ("U", 1), "camera_ids": ("U", 1), "photos": ("U", 0), "histogram": ("iu", 2), "point_idx": ("iu", 1),
    "rgb": ("u", 2), "row_rms_px": ("f", 2), "row_mean_px": ("f", 4), "cell_mean_px": ("f", 5),
    "histogram_px": ("f", 1), "points_w": ("f", 2), "global_points_w": ("f", 2),
}  # fmt: skip
# Points that are kept: as many as a phone rotates smoothly.
_MAX_POINTS = 15_000
# Bins along the readout, of all photos and of one; cells across and down the photo; bars of the histogram.
_ROWS, _ROWS_OF_PHOTO = 32, 12
_CELLS = (12, 9)
_BARS = 61


@dataclass(frozen=True)
class Diagnostics:
    """Fit of a solution and of a global-shutter adjustment to the same measurements; first axes of 2 are in that order.

    Attributes
    ----------
    names : tuple of str, length m
        Registered photos.
    rms_px : (2, m) array
        Root mean square of the residuals' x and y parts in each photo.
    depth : (m,) array
        Median depth of what each photo measured, world units.
    row_rms_px : (2, b) array
        The same over all photos by when in the readout a measurement was read, first to last; NaN where there is none.
    row_mean_px : (2, m, c, 2) array
        Mean residual (x, y) of each photo likewise: what a shutter that is not modelled leaves is a trend.
    cell_mean_px : (2, cameras, down, across, 2) array
        Mean residual over the photos of a camera, by where in the photo.
    camera_ids : tuple of str
        Of those cameras, in the solution.
    histogram_px : (n,) array
        Edges of the bars.
    histogram : (2, n - 1) int array
        Numbers of residuals' parts.
    points_w, global_points_w : (k, 3), (l, 3) array
        Some of the scene's points; those of the global-shutter adjustment are aligned with the solution by a similarity
        of the cameras.
    point_idx : (k,) int array
        Their indices among all points.
    rgb : (k, 3) uint8 array
        Their colours; empty where none are known.
    global_R_cw, global_center_w : (m, 3, 3), (m, 3) array
        Poses of the global-shutter adjustment, aligned.
    photos : str
        Folder of the photos relative to that of the outputs; empty if not known.
    """

    names: tuple[str, ...]
    rms_px: Array
    depth: Array
    row_rms_px: Array
    row_mean_px: Array
    cell_mean_px: Array
    camera_ids: tuple[str, ...]
    histogram_px: Array
    histogram: Index
    points_w: Array
    global_points_w: Array
    point_idx: Index
    rgb: NDArray[np.uint8]
    global_R_cw: Array
    global_center_w: Array
    photos: str = ""

    def __post_init__(self) -> None:
        m, k, num_global = len(self.names), len(self.points_w), len(self.global_points_w)
        b, c, n = self.row_rms_px.shape[-1], self.row_mean_px.shape[2], len(self.histogram_px)
        shapes: Mapping[str, tuple[tuple[int, ...], ...]] = {
            "rms_px": ((2, m),),
            "depth": ((m,),),
            "row_rms_px": ((2, b),),
            "row_mean_px": ((2, m, c, 2),),
            "cell_mean_px": ((2, len(self.camera_ids), *self.cell_mean_px.shape[2:4], 2),),
            "histogram": ((2, n - 1),),
            "points_w": ((k, 3),),
            "global_points_w": ((num_global, 3),),
            "point_idx": ((k,),),
            "rgb": ((k, 3), (0, 3)),
            "global_R_cw": ((m, 3, 3),),
            "global_center_w": ((m, 3),),
        }
        for name, allowed in shapes.items():
            if getattr(self, name).shape not in allowed:
                raise FormatError(f"{name} has the shape {getattr(self, name).shape}, expected {allowed[0]}")

    @classmethod
    def of_results(cls, result: BundleResult, global_result: BundleResult, camera_ids: ArrayLike) -> Diagnostics:
        """Diagnostics of an adjustment and its global-shutter counterpart, with the ids of cameras in the solution."""
        rec, plain = result.reconstruction, _aligned(global_result.reconstruction, result.reconstruction)
        both = [_Residuals(each) for each in (plain, rec)]
        chosen, of_plain = (_some(each.num_points) for each in (rec, plain))
        reach = max(*(np.quantile(np.abs(each.xy), 0.995) for each in both if each.xy.size), 0.1)
        edges = np.linspace(-reach, reach, _BARS)
        return cls(
            names=tuple(rec.image_names),
            rms_px=np.array([each.by_photo() for each in both]),
            depth=_median_depth(rec),
            row_rms_px=np.array([each.by_row() for each in both]),
            row_mean_px=np.array([each.by_photo_and_row() for each in both]),
            cell_mean_px=np.array([each.by_cell() for each in both]),
            camera_ids=tuple(str(key) for key in np.atleast_1d(np.asarray(camera_ids)).tolist()),
            histogram_px=edges,
            histogram=np.array([np.histogram(each.xy, edges)[0] for each in both]),
            points_w=rec.points_w[chosen],
            global_points_w=plain.points_w[of_plain],
            point_idx=chosen,
            rgb=np.zeros((0, 3), np.uint8),
            global_R_cw=plain.R_cw,
            global_center_w=plain.center_w,
        )

    def with_colors(self, rgb: NDArray[np.uint8] | None) -> Diagnostics:
        """The diagnostics with the colours (n, 3) of all points, if they are known."""
        return self if rgb is None else replace(self, rgb=rgb[self.point_idx])


def write_diagnostics(path: Path, diagnostics: Diagnostics) -> None:
    """Write `report.npz`, whole or not at all."""
    # values for display need no more than single precision
    values: dict[str, Any] = {
        name: v.astype(np.float32) if _is_float(v) else np.array(v) for name, v in vars(diagnostics).items()
    }
    file = io.BytesIO()
    np.savez_compressed(file, format=np.array(_FORMAT), version=np.array(_VERSION), **values)
    write_aside(Path(path), file.getvalue())


def read_diagnostics(path: Path) -> Diagnostics:
    """Read `report.npz`.

    Raises
    ------
    FileError, FormatError
        When it is missing, of another version, or garbled.
    """
    path = Path(path)
    arrays = read_arrays(path)
    if str(arrays.get("format")) != _FORMAT:
        raise FormatError(f"{path} is not of the format {_FORMAT!r}")
    if str(arrays.get("version")) != str(_VERSION):
        raise FormatError(f"{path} has version {arrays.get('version')}, this program reads {_VERSION}")
    values: dict[str, Any] = {}
    for each in fields(Diagnostics):
        if each.name not in arrays:
            raise FormatError(f"{path} lacks {each.name}")
        array, (kinds, axes) = arrays[each.name], _KINDS.get(each.name, ("f", None))
        if array.dtype.kind not in kinds or (axes is not None and array.ndim != axes):
            raise FormatError(f"{path}: {each.name} is {array.dtype} {array.shape}")
        values[each.name] = array.astype(np.float64) if _is_float(array) else array
    for name in ("names", "camera_ids"):
        values[name] = tuple(str(each) for each in values[name])
    values["photos"] = str(values["photos"])
    with format_errors(path):
        return Diagnostics(**values)


def _is_float(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind == "f"


def _some(count: int) -> Index:
    """Indices of some of `count` things, evenly spaced."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, _MAX_POINTS)).astype(np.int64))


def _aligned(rec: Reconstruction, like: Reconstruction) -> Reconstruction:
    """A reconstruction of the same photos in the frame of another: cameras, with the way they look, compare."""
    reach = like.size if like.num_points else like.baseline

    def marks(each: Reconstruction, unit: float) -> Array:
        ahead = each.center_w[:, None] + unit * each.R_cw
        return np.concatenate([each.center_w[:, None], ahead], axis=1).reshape(-1, 3)

    own = reach * rec.baseline / like.baseline
    scale, S, shift = align_points(marks(rec, own), marks(like, reach))
    return replace(
        rec,
        R_cw=rec.R_cw @ S.T,
        center_w=scale * rec.center_w @ S.T + shift,
        points_w=scale * rec.points_w @ S.T + shift,
    )


def _median_depth(rec: Reconstruction) -> Array:
    obs = rec.observations
    ahead = rec.R_cw[obs.frame_idx, 2]
    z = ((rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx]) * ahead).sum(1)
    return np.array([np.median(z[each]) if len(each) else np.nan for each in obs.by_photo(rec.num_images)])


class _Residuals:
    """Residuals (o, 2) of a reconstruction that could be projected, and where they are.

    `clock` (o,) runs from 0, read first, to 1; `place` (o, 2) from 0 to 1 across and down the photo.
    """

    def __init__(self, rec: Reconstruction) -> None:
        residuals, valid = reprojection_residuals(rec)
        obs = rec.observations
        self.rec, self.xy, self.frame_idx = rec, residuals[valid], obs.frame_idx[valid]
        camera = rec.camera_idx[self.frame_idx]
        sizes = np.array([(each.width, each.height) for each in rec.cameras], float)
        self.place = np.clip((obs.xy_raw[valid] + 0.5) / sizes[camera], 0, 1)
        axis = np.array([each.clock_axis for each in rec.cameras])[camera]
        sign = np.array([each.clock_sign for each in rec.cameras])[camera]
        along = self.place[np.arange(len(self.place)), axis]
        self.clock = np.where(sign > 0, along, 1 - along)

    def by_photo(self) -> Array:
        """(m,) root mean square."""
        return np.sqrt(_means(self.frame_idx, (self.xy**2).mean(1), self.rec.num_images))

    def by_row(self) -> Array:
        """(b,) root mean square."""
        return np.sqrt(_means(_bin(self.clock, _ROWS), (self.xy**2).mean(1), _ROWS))

    def by_photo_and_row(self) -> Array:
        """(m, c, 2) mean."""
        where = self.frame_idx * _ROWS_OF_PHOTO + _bin(self.clock, _ROWS_OF_PHOTO)
        return self._mean_xy(where, self.rec.num_images, _ROWS_OF_PHOTO)

    def by_cell(self) -> Array:
        """(cameras, down, across, 2) mean."""
        across, down = _CELLS
        cell = _bin(self.place[:, 1], down) * across + _bin(self.place[:, 0], across)
        where = self.rec.camera_idx[self.frame_idx] * down * across + cell
        return self._mean_xy(where, len(self.rec.cameras), down, across)

    def _mean_xy(self, where: Index, *shape: int) -> Array:
        """(*shape, 2) mean, by the number of the cell where each residual is."""
        mean = [_means(where, part, math.prod(shape)) for part in self.xy.T]
        return np.stack(mean, axis=-1).reshape(*shape, 2)


def _bin(place: Array, num: int) -> Index:
    return np.minimum((place * num).astype(np.int64), num - 1)


def _means(where: Index, values: Array, num: int) -> Array:
    """(num,) mean of the values of each index; NaN where there is none."""
    count = np.bincount(where, minlength=num)
    total = np.bincount(where, values, minlength=num)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
