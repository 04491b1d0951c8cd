"""Options of the functions that solve for motions, by topic."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..batch.rectify_options import RectifyOptions
from ..bundle import BundleOptions
from ..colmap.rectified_model import check_text_names
from ..critical import with_remedy
from ..errors import InputError
from ..input.gyroscope import GyroOptions
from ..input.pairing import MATCHINGS
from ..input.photo_cameras import PhotoCameras, check_readouts
from ..input.positions import check_crs
from ..io.cameras import check_sigma
from ..io.exports import check_exports
from ..model import Bend, ControlPoint, KnownLength, check_shutter_model
from ..model.checks import check_fields, check_whole
from ..sfm import DETECTION_MEGAPIXELS

__all__ = ["OutputOptions", "RunOptions", "SolveOptions"]

#: Frames of a video that are rectified.
FRAMES = ("key", "all")
#: When photos that are left out get affine features: if a strong shutter may be why, or always.
FEATURES = ("auto", "affine")

# Largest numbers of features by default.
_OF_PHOTO, _OF_KEY_FRAME = 8192, 2048


class _Part:
    """Options that name the class of an option that was theirs when there was one class."""

    def __new__(cls, *_: Any, **given: Any) -> Any:
        for name in sorted(given.keys() - cls.__dataclass_fields__.keys()):  # type: ignore[attr-defined]
            homes = [
                each for each in (SolveOptions, RectifyOptions, OutputOptions) if name in each.__dataclass_fields__
            ]
            if homes or name in ("jobs", "overwrite", "scheduler"):
                there = f"a field of {homes[0].__name__}" if homes else "an argument of run and solve"
                raise InputError(f"{cls.__name__} has no {name!r}, which is {there}")
        return super().__new__(cls)


@dataclass(frozen=True, kw_only=True)
class SolveOptions(_Part):
    """How the motions are found.

    Parameters
    ----------
    readout : str or mapping of group to str, optional
        Readout direction of all photos, or of groups; else that of the camera file; else a guess, which the fit
        decides.
    shutter_model : str
        "constant-motion", "rotation", "linearized", "two-step", "global", or "auto": the one that best predicts
        held-out measurements.
    seed : int
        Of every random choice.
    refine : tuple of str, optional
        Intrinsics that are estimated, as in `BundleOptions`, under a loose prior; () for none. By default all, under a
        prior as narrow as the camera is known: a calibration, or EXIF's guess.
    camera_sigma : mapping of intrinsic to float
        Standard deviations of the intrinsics, in pixels or of the coefficients; else those of the file, else the usual
        errors of calibrations, or of EXIF.
    still : mapping of photo name to float
        Photos known not to have moved by more than this angle in radians per frame (one standard deviation), as in
        `BundleOptions.still`.
    known : mapping of photo name to (phi, sigma)
        Motions known from elsewhere, as in `BundleOptions.known_phi`.
    known_bends : mapping of photo name to Bend
        Known deviations from steady motions, as in `BundleOptions.known_bends`.
    lengths : sequence of KnownLength
        Lengths measured in the scene, as in `BundleOptions.lengths`.
    crs : str, optional
        Frame of poses and points: "local", metres east, north and up at the photos' median GPS; a projection in metres
        for pyproj ("EPSG:32632"), less an origin in `Solution.georeference`; "none", an arbitrary one. By default
        "local" where GPS of three photos or more fits them; for `solve` the model's.
    control : sequence of ControlPoint
        Points on the ground that were measured, in that CRS; without a CRS, they define the frame.
    remedy : str
        What to do about a critical motion: "auto", "prior" or "none"; see `critical.heal`.
    readout_s : float, optional
        Readout time of a frame; else the log's, else that of the camera in the table, if it is there.
    """

    readout: str | Mapping[str, str] | None = None
    shutter_model: str = "auto"
    seed: int = 0
    refine: tuple[str, ...] | None = None
    camera_sigma: Mapping[str, float] = field(default_factory=dict)
    still: Mapping[str, float] = field(default_factory=dict)
    known: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)
    known_bends: Mapping[str, Bend] = field(default_factory=dict)
    lengths: Sequence[KnownLength] = ()
    crs: str | None = None
    control: Sequence[ControlPoint] = ()
    remedy: str = "auto"
    readout_s: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.shutter_model != "auto":
            check_shutter_model(self.shutter_model)
        check_readouts(self.readout)
        check_sigma(self.camera_sigma, "camera_sigma")
        check_whole(self.seed, "seed", 0)
        if self.refine == () and self.camera_sigma:
            raise InputError("refine none fixes the camera, camera_sigma says how far it may be off; give one of them")
        # fx and fy may be as far off as f is
        refined = {*(self.refine or self.camera_sigma), *(["f"] if {"fx", "fy"} & {*(self.refine or ())} else [])}
        if held := [name for name in self.camera_sigma if name not in refined]:
            raise InputError(f"camera_sigma says how far {held[0]} may be off, which refine keeps fixed; add it there")
        if self.shutter_model == "global" and (self.still or self.known or self.known_bends):
            raise InputError("a global shutter has no motion; leave out still and known, or give another shutter model")
        check_crs(self.crs)
        with_remedy(self.bundle_options(), self.remedy)
        if self.readout_s is not None and not 0 < self.readout_s < np.inf:
            raise InputError(f"readout_s={self.readout_s!r}, expected a positive number of seconds")

    def bundle_options(self) -> BundleOptions:
        """Options of the adjustments, as far as they do not depend on the cameras."""
        return BundleOptions(
            known_phi=self.known, known_bends=self.known_bends, still=self.still, lengths=self.lengths,
            refine=self.refine or (),
        )  # fmt: skip

    def options_for(self, cameras: PhotoCameras) -> BundleOptions:
        """Options of the adjustments of photos of these cameras."""
        options = self.bundle_options()
        if self.refine == ():
            return options
        # a calibration that is named to be refined is not trusted more than a guess, nor less
        cameras = cameras.with_sigma(self.camera_sigma)
        known = cameras.known_to(loose=self.refine is not None)
        return replace(options, refine=self.refine or cameras.intrinsics, guessed=known)


@dataclass(frozen=True, kw_only=True)
class OutputOptions(_Part):
    """Outputs besides the rectified photos.

    Parameters
    ----------
    sparse_format : str
        Format of the COLMAP model, "bin" or "txt".
    rs_poses : bool
        Whether the poses of the original photos with their shutter are written, for renderers that model it.
    usd : bool
        For a video with a path: write `camera.usda`, its camera at every frame and the points, for match-moving.
    exports : sequence of str
        Other programs to write the solution for, each into a folder of its name: "metashape", "ncore", "nuke",
        "opensfm", "opf" (the original photos) and "opf-rectified".
    report : bool
        Write `report.html`. Its data is kept in any case: `report.write_report` makes it later.
    """

    sparse_format: str = "bin"
    rs_poses: bool = False
    usd: bool = False
    exports: Sequence[str] = ()
    report: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        if self.sparse_format not in ("bin", "txt"):
            raise InputError(f"sparse_format={self.sparse_format!r}, expected bin or txt")
        check_exports(self.exports)

    def check_names(self, names: Iterable[str]) -> None:
        """Refuse photos whose names the outputs cannot hold."""
        if self.sparse_format == "txt":
            check_text_names(names)


@dataclass(frozen=True, kw_only=True)
class RunOptions(_Part):
    """Options of `run`: how photos are measured, how the motions are estimated, and what is made of the photos.

    Parameters
    ----------
    solve : SolveOptions
        How the motions are found.
    rectify : RectifyOptions
        What is done to each photo. There are no features where its `masks` are black. With `apply_orientation` photos
        that it mirrors are only rotated, and keep the mirror as their orientation: no camera takes a mirror image.
    outputs : OutputOptions
        Further outputs.
    camera : str, optional
        File or folder of cameras, or numbers, as `io.read_camera_file` takes them; else `camera.json` or `cameras.json`
        in or beside the folder of photos, else EXIF.
    max_features : int, optional
        Largest number of features per photo; by default 8192, and 2048 per key frame of a video, whose neighbours show
        the same.
    feature_megapixels : float
        Larger photos are reduced to this size to detect their features; all to a third of their own pixels where what
        these show matches well enough.
    features : {"auto", "affine"}
        What is done if photos are left out. "affine": all get features of the shape of their surroundings, too
        (`sfm.affine_features`), by which photos match that look from sides further apart; they take six times as long,
        and the solution with more photos counts. "auto": only if a strong shutter may be why.
    every, sharpest : int, optional
        For a video: each N-th frame, or the sharpest of each N frames, as in `io.extract_frames`; by default its frames
        share one path, and its key frames are the photos.
    frames : {"key", "all"}
        For a video with a path: rectify only its key frames, or all frames, into `video.mp4`, too.
    matching : str
        Photos that are matched: "exhaustive", all pairs; "neighbours", neighbours in order of capture, by GPS or by
        appearance; "auto", neighbours in sets of more than 60.
    gyro : GyroOptions, optional
        A gyroscope's log, for the motions that are neither `known` nor those of `still` photos.
    """

    solve: SolveOptions = field(default_factory=SolveOptions)
    rectify: RectifyOptions = field(default_factory=RectifyOptions)
    outputs: OutputOptions = field(default_factory=OutputOptions)
    camera: str | None = None
    max_features: int | None = None
    feature_megapixels: float = DETECTION_MEGAPIXELS
    features: str = "auto"
    every: int | None = None
    sharpest: int | None = None
    frames: str = "key"
    matching: str = "auto"
    gyro: GyroOptions | None = None

    def most_features(self, of_clip: bool) -> int:
        """Largest number of features of a photo, or of a key frame of a video."""
        return self.max_features or (_OF_KEY_FRAME if of_clip else _OF_PHOTO)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.max_features is not None and self.max_features < 100:
            raise InputError(f"max_features={self.max_features!r}, expected at least 100")
        if not 0.05 <= self.feature_megapixels < np.inf:
            raise InputError(f"feature_megapixels={self.feature_megapixels!r}, expected at least 0.05")
        if self.features not in FEATURES:
            raise InputError(f"features={self.features!r}, expected one of {', '.join(FEATURES)}")
        if self.frames not in FRAMES:
            raise InputError(f"frames={self.frames!r}, expected one of {', '.join(FRAMES)}")
        if self.frames == "all" and not (self.every is None and self.sharpest is None):
            raise InputError("all frames of a video are rectified by its path; leave --every and --sharpest out")
        if self.matching not in MATCHINGS:
            raise InputError(f"matching={self.matching!r}, expected one of {', '.join(MATCHINGS)}")
