"""Remap grids as values: to keep, to give to other programs, to invert, to apply to other images."""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._kernels import maps as kernels
from ..errors import FileError, FormatError, InputError
from ..model import Camera, Depth, RowMotion
from ..model.arrays import read_arrays
from ..model.checks import check_array, check_kind, check_size, check_whole, frozen
from ..model.values import ComparedByFields
from .maps import check_rectified, init_rectify_map, seen_by
from .photo import check_interpolation, check_photo, remap_strips

__all__ = ["MAP_KINDS", "RemapGrid"]

#: Kinds of files of grids, and their endings.
MAP_KINDS: dict[str, str] = {"npz": ".npz", "exr": ".exr", "stmap": ".exr"}

# Where a grid points when no pixel answers: outside of every photo, finite, since OpenCV 4 and 5 differ on NaN.
_NOWHERE = -1e6
# Packed maps have some pixels a byte; a header that claims more is believed up to a limit that does no harm.
_MOST_PIXELS_A_BYTE, _LEAST_LIMIT = 4, 1 << 24
# The attribute of our EXR files, with the kind and the size of the source.
_ATTRIBUTE = "rsundistort"


@dataclass(frozen=True, eq=False)
class RemapGrid(ComparedByFields):
    """For each pixel of an image, which pixel of its source it shows: (x, y), integer centres.

    Parameters
    ----------
    map_x, map_y : (height, width) float32 array
        Pixels of the source; far outside of it (x and y of -1e6) where none answers.
    source_width, source_height : int
        Size of the source.

    Examples
    --------
    >>> camera = Camera(64, 48, [[50, 0, 32], [0, 50, 24], [0, 0, 1]], [-0.1, 0, 0, 0])
    >>> grid = RemapGrid.from_camera(camera, RowMotion([0.05, 0.0, 0.02]))
    >>> there, seen = grid.apply(np.full((48, 64), 7, np.uint8))
    >>> back, known = grid.inverse().apply(there)
    >>> there.shape, bool((there[seen > 0] == 7).all())
    ((48, 64), True)
    """

    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    source_width: int
    source_height: int

    def __post_init__(self) -> None:
        for name in ("map_x", "map_y"):
            array = frozen(check_array(getattr(self, name), (None, None), name, np.float32))
            if not np.isfinite(array).all():
                raise InputError(f"{name} holds NaN or infinity")
            object.__setattr__(self, name, array)
        if self.map_x.shape != self.map_y.shape or not self.map_x.size:
            raise InputError(f"map_x.shape={self.map_x.shape}, map_y.shape={self.map_y.shape}, expected the same")
        for name in ("source_width", "source_height"):
            object.__setattr__(self, name, check_whole(getattr(self, name), name, 1))

    @classmethod
    def from_camera(
        cls,
        camera: Camera,
        motion: RowMotion | None = None,
        shutter_model: str = "rotation",
        new_camera: Camera | None = None,
        depth: Depth | None = None,
    ) -> RemapGrid:
        """The grid that `rectify` uses, of full size and exact.

        Parameters
        ----------
        camera, motion, shutter_model, new_camera, depth
            As in `rectify`.
        """
        check_kind(camera, Camera, "camera")
        target = camera.pinhole() if new_camera is None else check_rectified(new_camera)
        size = (target.width, target.height)
        map_x, map_y = init_rectify_map(camera, motion, shutter_model, new_K=target.K, size=size, depth=depth)
        assert map_y is not None
        return cls(map_x, map_y, camera.width, camera.height)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image that the grid makes."""
        return self.map_x.shape[1], self.map_x.shape[0]

    @property
    def seen(self) -> NDArray[np.uint8]:
        """(height, width): 255 where a pixel of the source answers, else 0."""
        return seen_by(self.map_x, self.map_y, self.source_width, self.source_height)

    def apply(
        self, image: NDArray[Any], interpolation: str = "cubic", jobs: int = 1
    ) -> tuple[NDArray[Any], NDArray[np.uint8]]:
        """An image of the source's size through the grid, and which pixels were seen; as `rectify`.

        Without its averaging of photos that get smaller: each pixel is one sample.
        """
        image = check_photo(image, self.source_width, self.source_height)

        def fill(row0: int, map_x: NDArray[np.float32], map_y: NDArray[np.float32], seen: NDArray[np.uint8]) -> bool:
            rows = slice(row0, row0 + len(map_x))
            map_x[:], map_y[:] = self.map_x[rows], self.map_y[rows]
            seen[:] = seen_by(map_x, map_y, self.source_width, self.source_height)
            return bool(seen.all())

        flag = check_interpolation(interpolation)
        return remap_strips(image, fill, self.size, flag, check_whole(jobs, "jobs", 1))

    def inverse(self) -> RemapGrid:
        """The way back: for each pixel of the source, which pixel of this grid's image shows it.

        Between four neighbours the grid is taken to be bilinear, which is inverted exactly: whatever made the grid, a
        shutter, depth, another program. Pixels of the source that the image does not show point nowhere. Of several
        that do, where the grid folds over, the first counts.
        """
        width, height = self.size
        map_x = np.full((self.source_height, self.source_width), _NOWHERE, np.float32)
        map_y = np.full_like(map_x, _NOWHERE)
        kernels.invert_map(self.map_x, self.map_y, map_x, map_y)
        return RemapGrid(map_x, map_y, width, height)

    def save(self, path: Path | str, kind: str = "npz") -> None:
        """Write the grid, whole or not at all.

        Parameters
        ----------
        path : path
            With the ending .npz or .exr.
        kind : {"npz", "exr", "stmap"}
            "npz": the fields of this class, for NumPy. "exr": 32-bit float OpenEXR, R = x and G = y in pixels.
            "stmap": OpenEXR in the convention of compositing programs (Nuke's STMap), R = (x + 0.5) / source width and
            G = 1 - (y + 0.5) / source height, which counts from the lower left corner. B is 1 where the source answers,
            else 0. EXR needs the extra `exr`.
        """
        path = Path(path)
        if kind not in MAP_KINDS:
            raise InputError(f"kind={kind!r}, expected one of {', '.join(MAP_KINDS)}")
        if path.suffix.lower() != MAP_KINDS[kind]:
            raise InputError(f"{path.name}: a grid of kind {kind!r} has the ending {MAP_KINDS[kind]}")
        aside = path.with_name(f".{secrets.token_hex(8)}.partial{path.suffix}")
        try:
            if kind == "npz":
                source = np.array([self.source_width, self.source_height])
                with aside.open("wb") as file:
                    np.savez(file, map_x=self.map_x, map_y=self.map_y, source_size=source)
            else:
                self._write_exr(aside, kind)
            aside.replace(path)
        except OSError as error:
            raise FileError(f"{path} cannot be written: {error.strerror or error}") from error
        finally:
            aside.unlink(missing_ok=True)

    def _write_exr(self, path: Path, kind: str) -> None:
        OpenEXR = _openexr()
        x, y = self.map_x, self.map_y
        if kind == "stmap":
            # in double precision, rounded once
            x = ((x + 0.5) / np.float64(self.source_width)).astype(np.float32)
            y = (1.0 - (y + 0.5) / np.float64(self.source_height)).astype(np.float32)
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            _ATTRIBUTE: f"{kind} {self.source_width} {self.source_height}",
        }
        channels = {"R": x, "G": y, "B": (self.seen > 0).astype(np.float32)}
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(str(path))
        except RuntimeError as error:
            raise OSError(str(error)) from error

    @classmethod
    def load(cls, path: Path | str, source_size: tuple[int, int] | None = None) -> RemapGrid:
        """Read a grid that `save` wrote, or another program's ST map.

        Parameters
        ----------
        path : path
            .npz, or .exr (extra `exr`).
        source_size : (width, height), optional
            Needed by ST maps of other programs, which do not hold it. Their NaN point nowhere.

        Raises
        ------
        FileError, FormatError
            When the file is missing, or no grid.
        """
        path = Path(path)
        if not path.is_file():
            raise FileError(f"{path} is no file; give a grid, .npz or .exr")
        try:
            if path.suffix.lower() != ".npz":
                return cls._read_exr(path, source_size)
            held = read_arrays(path)
            missing = [name for name in ("map_x", "map_y", "source_size") if name not in held]
            if missing:
                raise FormatError(f"it lacks {missing[0]}")
            width, height = check_size(held["source_size"], "source_size")
            return cls(held["map_x"], held["map_y"], width, height)
        except InputError as error:
            raise FormatError(f"{path} is no grid: {error}") from error
        except OSError as error:
            raise FileError(f"{path} cannot be read: {error.strerror or error}") from error

    @classmethod
    def _read_exr(cls, path: Path, source_size: tuple[int, int] | None) -> RemapGrid:
        OpenEXR = _openexr()
        try:
            with OpenEXR.File(str(path), header_only=True) as file:
                low, high = file.header()["dataWindow"]
            pixels, size = math.prod((np.asarray(high, int) - low + 1).tolist()), path.stat().st_size
            if pixels > max(_LEAST_LIMIT, _MOST_PIXELS_A_BYTE * size):
                raise FormatError(f"its header claims {pixels} pixels, more than its {size} bytes hold")
            with OpenEXR.File(str(path), separate_channels=True) as file:
                words = str(file.header().get(_ATTRIBUTE, "")).split()
                x, y = (np.asarray(file.channels()[name].pixels, np.float64) for name in "RG")
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            raise FormatError(f"{path} is no OpenEXR file that can be read: {error}") from error
        kind, width, height = words if len(words) == 3 else ("stmap", *(source_size or (0, 0)))
        if not width or not height:
            raise InputError(f"{path} does not say how large its source is; give source_size")
        width, height = check_size([float(width), float(height)], "source_size")
        if kind == "stmap":
            x, y = x * width - 0.5, (1.0 - y) * height - 0.5
        nowhere = ~(np.isfinite(x) & np.isfinite(y))
        x[nowhere] = y[nowhere] = _NOWHERE
        return cls(x.astype(np.float32), y.astype(np.float32), width, height)


def _openexr() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError('EXR files need the extra: pip install "rsundistort[exr]"') from error
    return OpenEXR
