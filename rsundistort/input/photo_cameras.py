"""The camera of each photo, and its readout direction."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..bundle import BundleOptions, GuessedCameras, deviation, pixels_of
from ..bundle.intrinsics import check_lenses
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..io import CameraFile, ExifFacts, camera_from_exif, check_camera_fits, groups_of, guess_readouts, read_camera_file
from ..model import Camera, check_readout
from ..model.array_types import Index
from ..sfm import USUAL_FOCAL

__all__ = ["GIVEN_SIGMA", "GUESS_SIGMA", "PhotoCameras", "camera_file_of", "check_readouts", "find_cameras"]

#: Standard deviations of EXIF's guess (relative f, principal point in focal lengths, lens coefficients): equivalent
#: focal lengths are rounded to millimetres, focusing and stabilising crop a little, phones hardly distort, and lenses
#: are hardly decentred (p1 and p2 trade against cx, cy and a phi3 that all photos share).
GUESS_SIGMA = {"f": 0.05, "cx": 0.01, "cy": 0.01, "k1": 0.2, "k2": 0.4, "k3": 0.4, "k4": 0.4, "p1": 1e-3, "p2": 1e-3}
#: Standard deviations of a calibration: published ones of good cameras were off by half a pixel.
GIVEN_SIGMA = {
    "f": 1e-3, "cx": 4e-4, "cy": 4e-4, "k1": 3e-3, "k2": 1e-2, "k3": 1e-2, "k4": 1e-2, "p1": 3e-4, "p2": 3e-4
}  # fmt: skip
# Of a calibration's error of cx and p2, or cy and p1, together, which photos without a shutter do not show: that of
# herz-jesus-8 is 1.06e-3 (cx is off by 3 pixels), as its photos with known motions tell.
_GIVEN_DECENTRING = 1e-3

# Estimates of unknown cameras are rejected beyond this many standard deviations.
_LIKE_NO_CAMERA = 6.0

#: Names of camera files that are found automatically.
_BESIDE = ("camera.json", "cameras.json")


@dataclass(frozen=True)
class PhotoCameras:
    """The cameras of a folder's photos.

    Attributes
    ----------
    cameras : sequence of Camera
        Each a body in one mode, read out one way.
    labels : sequence of str
        Their names, for people.
    camera_idx : (m,) int array
        Camera of each photo.
    calibrated : bool
        Whether they were given; else they are EXIF's guesses.
    readout_specified : tuple of bool
        Whether the readout direction of each camera was given; else it is a guess.
    source : str
        Where they come from, for people.
    notes : sequence of str
        The guesses, for people.
    sigma : sequence of mapping of intrinsic to float
        Given standard deviations of each camera, in the units of `GuessedCameras`; others are the defaults of
        `known_to`.
    without_focal : sequence of int
        Cameras with unknown focal length: they have the usual one.
    """

    cameras: Sequence[Camera]
    labels: Sequence[str]
    camera_idx: Index
    calibrated: bool
    readout_specified: tuple[bool, ...]
    source: str
    notes: Sequence[str] = ()
    sigma: Sequence[Mapping[str, float]] = ()
    without_focal: Sequence[int] = ()

    def of(self, image: int) -> Camera:
        """The camera of a photo."""
        return self.cameras[int(self.camera_idx[image])]

    @property
    def intrinsics(self) -> tuple[str, ...]:
        """Intrinsics that are always estimated, under the prior of `known_to`."""
        lenses = {camera.lens for camera in self.cameras}
        focal = ("fx", "fy") if any({"fx", "fy"} & each.keys() for each in self.sigma) else ("f",)
        names = (*focal, "cx", "cy", "k1", "k2", "k3")
        return (*names, *(["k4"] if "fisheye" in lenses else []), *(["p1", "p2"] if "pinhole" in lenses else []))

    def known_to(self, loose: bool) -> GuessedCameras:
        """Prior of the cameras: with the given standard deviations, else those of calibrations or guesses.

        Only calibrations without given ones may be decentred besides: a guess is wide enough.
        """
        default = GUESS_SIGMA if loose or not self.calibrated else GIVEN_SIGMA
        sigmas, decentring = [], []
        for specified in self.sigma or [{}] * len(self.cameras):
            sigma = {**default, "fx": default["f"], "fy": default["f"], **specified}
            if "f" in specified:
                sigma |= {name: specified.get(name, specified["f"]) for name in ("fx", "fy")}
            sigmas.append(sigma)
            by_rows, by_columns = (
                0.0 if {*pair} & {*specified} else _GIVEN_DECENTRING for pair in (("cx", "p2"), ("cy", "p1"))
            )
            decentring.append((by_rows, by_columns))
        return GuessedCameras(self.cameras, sigmas, decentring if default is GIVEN_SIGMA else ())

    def likely_sigma(self, image: int) -> dict[str, float]:
        """By how much guesses of cameras like that of a photo are off, whether or not it is known better.

        The intrinsics are in the units of `GuessedCameras`.
        """
        k = int(self.camera_idx[image])
        of_file = self.sigma[k].get("f", 0.0) if self.sigma else 0.0
        return {**GUESS_SIGMA, "f": max(GUESS_SIGMA["f"], of_file)}

    def sigma_of_file(self, k: int) -> dict[str, float]:
        """Standard deviations of a camera for `camera.json`; {} of a calibration that has the default ones."""
        camera = self.cameras[k]
        sigma = {**({} if self.calibrated else GUESS_SIGMA), **(self.sigma[k] if self.sigma else {})}
        names = [name for name in sigma if name in self.intrinsics]
        return {name: sigma[name] * float(pixels) for name, pixels in zip(names, pixels_of(camera, names), strict=True)}

    def with_sigma(self, sigma: Mapping[str, float]) -> PhotoCameras:
        """The cameras, all known to these standard deviations, in pixels or of the coefficients."""
        check_lenses([*sigma], self.cameras, "camera_sigma:")
        specified = self.sigma or [{}] * len(self.cameras)
        return replace(
            self, sigma=[{**old, **_relative(sigma, c)} for old, c in zip(specified, self.cameras, strict=True)]
        )  # fmt: skip

    def check_plausible(self, cameras: Sequence[Camera], sigmas: Sequence[Mapping[str, float]] = ()) -> None:
        """Refuse implausible estimates of cameras that were unknown: `cameras` are the estimates.

        Photos without parallax, or of things that move, make a lens of whatever bends them. A principal point alone
        that lies off the middle is that of photos that were cropped, if they determine it: a warning.

        Parameters
        ----------
        sigmas : sequence of mapping
            Standard deviations of each camera's intrinsics, in pixels or of the coefficients.

        Raises
        ------
        ReconstructionError
            With what is odd.
        """
        odd = [
            each for each in self.known_to(loose=True).surprises(cameras)
            if each[0] in self.without_focal and each[2] > _LIKE_NO_CAMERA
        ]  # fmt: skip
        for k, name, times in odd:
            (fx, _, cx), (_, fy, cy), _ = cameras[k].K.tolist()
            value = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **cameras[k].coefficients}[name]
            sigma = sigmas[k].get(name, np.inf) if sigmas else np.inf
            if {each for i, each, _ in odd if i == k} <= {"cx", "cy"} and sigma < GUESS_SIGMA["cx"] * fx:
                warnings.warn(
                    f"{self.labels[k]}: its principal point is at ({cx:.0f}, {cy:.0f}), far off the middle of "
                    f"{cameras[k].width}x{cameras[k].height}: the photos were probably cropped",
                    RsUndistortWarning, stacklevel=3,
                )  # fmt: skip
                continue
            raise ReconstructionError(
                f"the photos do not determine their camera: {name} = {value:.3g} would be {times:.0f} standard "
                "deviations from what such cameras have; give --camera FILE or --camera fx,fy,cx,cy in pixels "
                "(of a fisheye a FILE, which names its lens)"
            )

    def contradicted(self, cameras: Sequence[Camera], options: BundleOptions) -> list[str]:
        """Calibrations that the photos contradict, for people; `cameras` are the estimates with these options."""
        if options.guessed is None or not self.calibrated:
            return []
        said = []
        for k, name, times in options.guessed.surprises(cameras):
            if name not in options.refine:
                continue
            (apart,), _ = deviation(cameras[k], self.cameras[k], [name])
            off = f"{apart * pixels_of(cameras[k], [name])[0]:+.3g}{' px' if name[0] in 'fc' else ''}"
            said.append(
                f"{self.source}: {name} is off by {off} by these photos ({times:.0f} standard deviations), which were "
                "used; calibrate again, or give --refine none"
            )
        return said


def check_readouts(readout: str | Mapping[str, str] | None) -> dict[str, str]:
    """Directions by group, the empty name for all others; refused where one is no direction."""
    specified = {"": readout} if isinstance(readout, str) else dict(readout or {})
    for group, direction in specified.items():
        check_readout(direction, f"readout of {group}" if group else "readout")
    return specified


def camera_file_of(folder: Path, camera: str | None) -> Path | None:
    """The file or folder of the cameras of a folder's photos; None if numbers or EXIF give them.

    Raises
    ------
    InputError
        Both files that a folder may hold are there.
    """
    if camera is not None:
        return Path(camera) if os.path.exists(camera) else None
    # "." and ".." have no parent of their own
    around = Path(os.path.abspath(folder)).parent if folder.name in ("", "..") else folder.parent
    for parent in (folder, around):
        beside = [parent / name for name in _BESIDE if (parent / name).is_file()]
        if len(beside) > 1:
            raise InputError(f"{parent} holds {' and '.join(_BESIDE)}; remove one, or say --camera which to use")
        if beside:
            return beside[0]
    return None


def find_cameras(
    folder: Path,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    facts: Sequence[ExifFacts],
    camera: str | None = None,
    readout: str | Mapping[str, str] | None = None,
) -> PhotoCameras:
    """The cameras of a folder's photos: as given, `camera.json` or `cameras.json` in the folder or beside it, or EXIF.

    Parameters
    ----------
    names, sizes, facts : sequences of length m
        Photos, their (width, height) and what their EXIF says.
    camera : str, optional
        As `io.read_camera_file` takes it.
    readout : str or mapping, optional
        Readout direction of all photos, or by group (the label of a camera); overrides the file's.

    Raises
    ------
    InputError
        A photo has no camera, or one of another size.
    """
    groups = groups_of(facts, sizes)
    if camera is None and (beside := camera_file_of(folder, None)) is not None:
        camera = str(beside)
    if camera is not None:
        file = read_camera_file(camera, *sizes[0])
        known, keys = _keys_in(file, camera, names, sizes, groups)
        calibrated, source, notes, usual = True, file.source, list[str](), set[str]()
        in_file, sigma_of = file.readout_specified, file.sigma
    else:
        known, keys, notes, usual = _from_exif(folder, names, sizes, facts, groups)
        calibrated, source, in_file, sigma_of = False, "EXIF, refined", frozenset[str](), {}
    labels = list(dict.fromkeys(keys))
    specified = check_readouts(readout)
    unknown = sorted(specified.keys() - {"", *labels})
    if unknown:
        raise InputError(f"readout of {unknown[0]!r}: no such group of photos, there are {', '.join(labels)}")
    cameras = []
    for label in labels:
        found = known[label]
        direction = specified.get(label, specified.get(""))
        cameras.append(found if direction is None else replace(found, readout=direction))
    place = {label: k for k, label in enumerate(labels)}
    return PhotoCameras(
        tuple(cameras),
        tuple(labels),
        np.array([place[key] for key in keys], np.int64),
        calibrated,
        tuple(label in specified or "" in specified or label in in_file for label in labels),
        source,
        tuple(note for note in notes if not specified),
        [_relative(sigma_of.get(label, {}), known[label]) for label in labels],
        [k for k, label in enumerate(labels) if label in usual],
    )


def _relative(sigma: Mapping[str, float], camera: Camera) -> dict[str, float]:
    """Standard deviations in pixels in the units of `GuessedCameras`."""
    return {name: value / float(pixels_of(camera, [name])[0]) for name, value in sigma.items()}


def _keys_in(
    file: CameraFile, where: str, names: Sequence[str], sizes: Sequence[tuple[int, int]], groups: Sequence[str]
) -> tuple[dict[str, Camera], list[str]]:
    """Cameras of the file, those without a size for the photos that they took; and the camera of each photo.

    That is by its name, else by its group, else the only one, else the only one of its size, else the only one that has
    none, and no group's name.
    """
    cameras, keys, open_ = dict(file.cameras), list[str](), {*file.without_size}
    free = [key for key in cameras if key in open_ and key not in groups]
    by_size = list[str]()
    for name, size, group in zip(names, sizes, groups, strict=True):
        of_size = [key for key, each in file.cameras.items() if (each.width, each.height) == size]
        fitting = [key for key in of_size if key not in file.without_size] or free
        if file.camera_of_image:
            if name not in file.camera_of_image:
                raise InputError(f"{where} says of no camera that it took {name}; name it there, or move it away")
            key = file.camera_of_image[name]
        elif len(file.cameras) == 1:
            (key,) = file.cameras
        elif group in file.cameras:
            key = group
        elif len(fitting) == 1:
            (key,) = fitting
            by_size.append(name)
        else:
            raise _no_camera_for(name, size, group, where, "no camera" if not fitting else "several cameras")
        if key in open_:
            cameras[key] = replace(cameras[key], width=size[0], height=size[1])
            open_.remove(key)
        check_camera_fits(cameras[key], *size, f"{where} for {name}")
        keys.append(key)
    # a camera of no size that took no photo may have taken those
    if by_size and open_ & {*free}:
        i = names.index(by_size[0])
        raise _no_camera_for(names[i], sizes[i], groups[i], where, "several cameras")
    return cameras, keys


def _no_camera_for(name: str, size: tuple[int, int], group: str, where: str, which: str) -> InputError:
    return InputError(f"{where} holds {which} of the size of {name}, {size[0]}x{size[1]}; call its file {group}.json")


def _from_exif(
    folder: Path,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    facts: Sequence[ExifFacts],
    groups: Sequence[str],
) -> tuple[dict[str, Camera], list[str], list[str], set[str]]:
    """Cameras by group with the focal length of EXIF, the group of each photo, the guesses, groups without EXIF's.

    Where EXIF has none, the usual one stands in its place.
    """
    directions, notes = guess_readouts(facts, sizes, groups)
    known: dict[str, Camera] = {}
    usual: dict[str, Camera] = {}
    for name, size, group in zip(names, sizes, groups, strict=True):
        if group not in known:
            guess = camera_from_exif(folder / name, *size, directions[group])
            if guess is not None:
                known[group] = guess
            elif group not in usual:
                usual[group] = _usual_camera(*size, directions[group])
    without = usual.keys() - known.keys()
    return usual | known, list(groups), list(notes), without


def _usual_camera(width: int, height: int, readout: str) -> Camera:
    """A camera with the usual focal length."""
    focal = USUAL_FOCAL[0] * max(width, height)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K, readout=readout)
