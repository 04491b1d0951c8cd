"""Golden images: pictures and arrays that tests compare within a tolerance, and make again on request.

With the package installed, pytest knows the option `--regolden` and the fixture `golden`:

    def test_photo_is_rectified(golden):
        rectified, mask = rs.rectify(photo, camera, motion)
        golden.image("photo.png", rectified, max_grey=2, max_share=0.001)

compares with `golden/photo.png` beside the test's file; `pytest --regolden` writes that file instead.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import FileError, FormatError, InputError
from .io import read_photo, write_image
from .model.array_types import Array, Mask
from .model.arrays import read_arrays

__all__ = ["Golden", "assert_images_close"]

_ARRAY_SUFFIXES = (".npy", ".npz")

#: Steps of a type that make one grey level of 8 bit: 65535 / 255 for 16 bit. Floats have no grey levels.
_STEPS_PER_GREY = {"uint8": 1.0, "uint16": 257.0}


def assert_images_close(
    got: ArrayLike,
    expected: ArrayLike | str | Path,
    *,
    max_grey: float,
    max_share: float = 0.0,
    mask: ArrayLike | None = None,
    out: str | Path | None = None,
) -> None:
    """Fail unless two pictures are the same within a tolerance.

    Parameters
    ----------
    got : (h, w) or (h, w, channels) array
        uint8, uint16 or floats; the channels in OpenCV's order. A last axis of length 1 is dropped, on both sides.
    expected : array, or path
        As `got`; or the file that holds it: PNG, TIFF and so on, .npy, or .npz with one array.
    max_grey : float
        Largest difference of a pixel that is no difference, over all its channels. In grey levels of 8 bit: 1 allows
        1 step of uint8 and 257 steps of uint16. For floats it is absolute, in their own unit. NaN equals NaN only.
    max_share : float
        Share of the pixels, 0 to 1, that may differ by more than `max_grey`, however much.
    mask : (h, w) array, optional
        Pixels to compare are those that are not 0; the share is of these.
    out : path, optional
        Folder for the pictures of a failure; a new one for temporary files when left out.

    Raises
    ------
    AssertionError
        When pixels differ, the shapes or types do, or the file is missing. The text says how many pixels, by how much,
        where the worst is, and names three pictures that were written: `expected.png`, `got.png` and `difference.png`,
        in which black is equal, dark is within the tolerance, and bright is beyond.
    InputError, FileError
        When the arguments make no comparison: other types, an empty mask, a file that is no picture.

    Examples
    --------
    >>> photo = np.full((4, 6), 100, np.uint8)
    >>> assert_images_close(photo + np.uint8(1), photo, max_grey=1)
    """
    __tracebackhide__ = True  # pytest shows the caller's line
    _check_tolerance(max_grey, "max_grey")
    if not 0.0 <= max_share <= 1.0:
        raise InputError(f"max_share={max_share}, expected 0 to 1")
    picture, target = _as_picture(got, "got"), _expected_picture(expected)
    if picture.shape != target.shape or picture.dtype != target.dtype:
        shown = _write_pictures(out, expected=_show(target), got=_show(picture))
        raise AssertionError(f"{_unlike(picture, target)}\n{shown}")
    compared = _compared(mask, picture.shape[:2])
    steps = _STEPS_PER_GREY.get(picture.dtype.name, 1.0)
    difference = _difference(picture, target) / steps
    by_pixel = np.where(compared, difference if difference.ndim == 2 else difference.max(axis=2), 0.0)
    beyond = int(np.count_nonzero(by_pixel > max_grey))
    total = int(np.count_nonzero(compared))
    if beyond <= max_share * total:
        return
    low, high = _range(picture, target)
    shown = _write_pictures(
        out,
        expected=_show(target, low, high),
        got=_show(picture, low, high),
        difference=_show_difference(by_pixel, max_grey),
    )
    row, column = (int(i) for i in np.unravel_index(int(by_pixel.argmax()), by_pixel.shape))
    unit = " grey levels" if picture.dtype.name in _STEPS_PER_GREY else ""
    raise AssertionError(
        f"{beyond} of {total} pixels ({beyond / total:.3%}) differ by more than {max_grey:g}{unit}; "
        f"{max_share:.3%} may\n"
        f"worst: {by_pixel[row, column]:.4g}{unit} at row {row}, column {column}: "
        f"got {picture[row, column]}, expected {target[row, column]}\n{shown}"
    )


@dataclass(frozen=True)
class Golden:
    """Golden files of a folder; what the fixture `golden` gives.

    Attributes
    ----------
    folder : Path
        Of the golden files: `golden` beside the test's file.
    out : Path
        Folder for what a failure leaves; the fixture takes the test's `tmp_path`.
    remake : bool
        Write the golden files instead of comparing; `pytest --regolden`.
    """

    folder: Path
    out: Path
    remake: bool = False

    def image(
        self, name: str, got: ArrayLike, *, max_grey: float, max_share: float = 0.0, mask: ArrayLike | None = None
    ) -> None:
        """Compare a picture with the golden file `name`, or write it.

        Parameters
        ----------
        name : str
            File in the folder; PNG, since what is compared must not be compressed with loss.
        got : (h, w) or (h, w, 3 | 4) array
            uint8 or uint16.
        max_grey, max_share, mask
            As in `assert_images_close`.
        """
        __tracebackhide__ = True
        picture = _as_picture(got, "got")
        if Path(name).suffix.lower() != ".png" or picture.dtype.name not in _STEPS_PER_GREY:
            raise InputError(
                f"{name} of {picture.dtype}: golden images are uint8 or uint16, and PNG; for floats use golden.array"
            )
        if self.remake:
            self._write(name, lambda path: write_image(path, picture))
            return
        out = self.out / Path(name).stem
        assert_images_close(picture, self.folder / name, max_grey=max_grey, max_share=max_share, mask=mask, out=out)

    def array(self, name: str, got: ArrayLike, *, atol: float) -> None:
        """Compare an array with the golden file `name`, or write it.

        Parameters
        ----------
        name : str
            File in the folder: .npy, or .npz (compressed).
        got : array
            Numbers of any shape.
        atol : float
            Largest absolute difference, in the array's own unit. NaN equals NaN only.
        """
        __tracebackhide__ = True
        _check_tolerance(atol, "atol")
        values = np.asarray(got)
        if Path(name).suffix.lower() not in _ARRAY_SUFFIXES or values.dtype.kind not in "fiu":
            raise InputError(f"{name} of {values.dtype}: golden arrays hold real numbers and are .npy or .npz")
        if self.remake:
            self._write(name, lambda path: _save(path, values))
            return
        path = self.folder / name
        target = _read(path)
        kept = self.out / name
        if values.shape != target.shape or values.dtype != target.dtype:
            problem = _unlike(values, target)
        else:
            difference = _difference(values, target)
            beyond = int(np.count_nonzero(difference > atol))
            if not beyond:
                return
            worst = np.unravel_index(int(difference.argmax()), difference.shape)
            problem = (
                f"{beyond} of {values.size} numbers ({beyond / values.size:.3%}) differ by more than {atol:g}\n"
                f"worst: {difference[worst]:.4g} at {[int(i) for i in worst]}: got {values[worst]}, expected "
                f"{target[worst]}"
            )
        kept.parent.mkdir(parents=True, exist_ok=True)
        _save(kept, values)
        raise AssertionError(f"{problem}\nexpected: {path}\ngot: {kept}")

    def _write(self, name: str, write: Callable[[Path], None]) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)


def _check_tolerance(value: float, name: str) -> None:
    """Refuse a tolerance that is negative or NaN: NaN would let everything pass."""
    if not value >= 0:
        raise InputError(f"{name}={value}, expected 0 or more")


def _unlike(got: NDArray[Any], expected: NDArray[Any]) -> str:
    return f"got {got.dtype} {got.shape}, expected {expected.dtype} {expected.shape}: these do not compare"


def _as_picture(value: ArrayLike, name: str) -> NDArray[Any]:
    """The value as an array (h, w) or (h, w, channels > 1)."""
    array = np.asarray(value)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    kinds = array.dtype.name in _STEPS_PER_GREY or array.dtype.kind == "f"
    if not kinds or array.ndim not in (2, 3) or array.size == 0:
        raise InputError(f"{name} is {array.dtype} {array.shape}, expected uint8, uint16 or floats (h, w[, channels])")
    return array


def _expected_picture(expected: ArrayLike | str | Path) -> NDArray[Any]:
    """The picture that is given, or that a golden file holds."""
    __tracebackhide__ = True
    if not isinstance(expected, (str, Path)):
        return _as_picture(expected, "expected")
    path = Path(expected)
    return _as_picture(_read(path), str(path))


def _compared(mask: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """Which pixels are compared: those where the mask is not 0."""
    compared = np.ones(shape, bool) if mask is None else np.asarray(mask) != 0
    if compared.shape != shape:
        raise InputError(f"mask.shape={compared.shape}, expected {shape}")
    if not compared.any():
        raise InputError("mask leaves no pixel to compare")
    return compared


def _read(path: Path) -> NDArray[Any]:
    """The picture or the array in a golden file."""
    __tracebackhide__ = True
    if not path.is_file():
        raise AssertionError(
            f"golden file {path} is missing; make it with pytest --regolden (fixture `golden`), look at it, and commit "
            "it"
        )
    if path.suffix.lower() not in _ARRAY_SUFFIXES:
        return read_photo(path).pixels
    try:
        arrays = read_arrays(path)
    except (FileError, FormatError) as error:
        raise FileError(f"{path} cannot be read as an array: {error}") from error
    if len(arrays) != 1:
        raise FormatError(f"{path} holds {len(arrays)} arrays, expected one")
    return next(iter(arrays.values()))


def _save(path: Path, values: NDArray[Any]) -> None:
    if path.suffix.lower() == ".npz":
        np.savez_compressed(path, array=values)
    else:
        np.save(path, values)


def _difference(got: NDArray[Any], expected: NDArray[Any]) -> Array:
    """Absolute differences; 0 where both are the same NaN or infinity, infinite where only one is."""
    a, b = got.astype(np.float64), expected.astype(np.float64)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore"):
        difference = np.abs(a - b)
    return np.where(same, 0.0, np.where(np.isnan(difference), np.inf, difference))


def _range(*pictures: NDArray[Any]) -> tuple[float, float]:
    """Smallest and largest finite value: what float pictures are shown between."""
    finite = np.concatenate([p[np.isfinite(p)].ravel() for p in pictures]).astype(np.float64)
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _show(picture: NDArray[Any], low: float | None = None, high: float | None = None) -> NDArray[Any]:
    """The picture as PNG can hold it: integers as they are, floats stretched to 8 bit between low and high."""
    if picture.dtype.kind == "f":
        if low is None or high is None:
            low, high = _range(picture)
        shown = np.clip(np.nan_to_num(picture.astype(np.float64), nan=low), low, high)
        # the difference of two very large numbers may overflow, that of their halves does not
        span = max(high / 2 - low / 2, np.finfo(np.float64).tiny)
        picture = np.rint(255 * ((shown / 2 - low / 2) / span)).astype(np.uint8)
    if picture.ndim == 3 and picture.shape[2] == 2:  # x and y of a grid, in blue and green
        picture = np.dstack([picture, np.zeros_like(picture[..., 0])])
    if picture.ndim == 3 and picture.shape[2] > 4:
        picture = picture[..., :3]
    return np.ascontiguousarray(picture)


def _show_difference(by_pixel: Array, tolerance: float) -> NDArray[np.uint8]:
    """Grey picture of differences: up to 100 within the tolerance, 160 to 255 beyond, so that lone pixels show."""
    finite = by_pixel[np.isfinite(by_pixel)]
    worst = max(float(finite.max(initial=0.0)), np.finfo(np.float64).tiny)
    within = 100.0 * by_pixel / (tolerance if tolerance > 0 else 1.0)
    beyond = 160.0 + 95.0 * np.minimum(by_pixel / worst, 1.0)
    return np.rint(np.where(by_pixel > tolerance, beyond, within)).astype(np.uint8)


def _write_pictures(out: str | Path | None, **pictures: NDArray[Any]) -> str:
    """Write the pictures of a failure; the lines that name them."""
    folder = Path(tempfile.mkdtemp(prefix="rsundistort-golden-")) if out is None else Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for name, pixels in pictures.items():
        path = folder / f"{name}.png"
        write_image(path, pixels)
        lines.append(f"{name}: {path}")
    return "\n".join(lines)
