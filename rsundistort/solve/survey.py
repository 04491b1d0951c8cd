"""Georeferencing of a reconstruction: by GPS of its photos, and by control points."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..bundle import (
    CONTROL_SIGMA_PX,
    KnownPlaces,
    measured_lengths,
    place_control,
    scale_of_lengths,
    with_control,
)
from ..bundle.known_positions import point_of, stacked
from ..errors import InputError, RsUndistortWarning
from ..input.gyroscope import Readouts
from ..input.photo_cameras import PhotoCameras
from ..input.positions import MapFrame, PhotoPositions, frame_at, frame_of_control, positions_of
from ..io import ExifFacts
from ..model import ControlPoint, KnownLength, Reconstruction
from ..model.array_types import Array, Index
from ..model.similarity import FittedSimilarity, Similarity, fit_similarity

__all__ = ["Survey", "clocks_of", "survey_of"]

_LEAST = 3
# Places georeference a model if they determine its rotation and scale to this: radians, relative.
_MOST_TURN, _MOST_SCALE = np.deg2rad(10.0), 0.1
# The nearer half of the photos lies within this many standard deviations of GPS, or GPS is of other photos.
_MOST_OFF = 4.0
# Control points farther from the photos' GPS are of another CRS, metres.
_ELSEWHERE_M = 1e5
# Known lengths that are off by more standard deviations contradict the map.
_CONTRADICTS = 3.0
# Standard deviation of axes by a gimbal and its compass, radians; photos that deviate more than the second are
# rejected.
_GIMBAL_SIGMA, _GIMBAL_OFF = np.deg2rad(5.0), np.deg2rad(20.0)
# Number of photos, spread over the flight, that are compared with each other for the middle one.
_SOME = 100
# Standard deviation of a velocity by GPS along each axis, m/s, and of the time that multiplies it, relative.
_VELOCITY_SIGMA_M_S, _VELOCITY_SHARE = 0.3, 0.03


@dataclass(frozen=True)
class Survey:
    """Known positions, in the frame of the map.

    Attributes
    ----------
    frame : MapFrame
        Of the poses and points.
    positions : PhotoPositions
        The photos' GPS, with velocities and rotations along the axes of the frame.
    places : mapping of photo name to (place, sigma)
        Their places in the frame, (3,) each; none if the frame is that of control points.
    control : sequence of ControlPoint
        In the frame.
    gps_offset_m : (3,) array
        Offset that is added to GPS to agree with the control points.
    clock_s : mapping of photo name to float
        Readout times, in seconds, where time and direction were specified: GPS then gives velocities.
    fit : FittedSimilarity or None
        The similarity that was applied to the reconstruction.
    """

    frame: MapFrame
    positions: PhotoPositions
    places: Mapping[str, tuple[Array, Array]]
    control: Sequence[ControlPoint] = ()
    gps_offset_m: Array = field(default_factory=lambda: np.zeros(3))
    clock_s: Mapping[str, float] = field(default_factory=dict)
    fit: FittedSimilarity | None = None
    notes: Sequence[str] = ()

    @property
    def holding(self) -> list[ControlPoint]:
        """Control points that are no check points."""
        return [point for point in self.control if not point.is_check]

    def known(self, rec: Reconstruction) -> KnownPlaces | None:
        """Positions for the adjustment of a reconstruction; none before that is in the frame."""
        if self.fit is None:
            return None
        velocities = {}
        for name, velocity in zip(self.positions.names, self.positions.velocity_m_s, strict=True):
            if name in self.clock_s and name in self.places and name in rec.image_names and np.isfinite(velocity).all():
                unit_s = self.clock_s[name] / rec.camera(rec.image_names.index(name)).frame_span
                sigma = max(_VELOCITY_SIGMA_M_S, _VELOCITY_SHARE * float(np.linalg.norm(velocity)))
                velocities[name] = (unit_s * velocity, np.full(3, unit_s * sigma))
        return KnownPlaces(self.places, self.holding, velocities)

    def placed(self, rec: Reconstruction) -> tuple[Survey | None, Reconstruction]:
        """The reconstruction in the frame by GPS; as it was, and no survey, if GPS does not fit it.

        If the frame is that of control points, they are applied once motions are known.
        """
        if not self.places:
            return self, rec
        names = [name for name in rec.image_names if name in self.places]
        problem = f"{len(names)} of the registered photos have GPS, three are needed"
        if len(names) >= _LEAST:
            fit = self._fitted(rec, *_of_photos(rec, self.places))
            problem = _misfit(fit, "GPS")
            if not problem:
                return replace(self, fit=fit), fit.similarity.of_reconstruction(rec)
        if len(self.holding) >= _LEAST:  # these will
            return self, rec
        warnings.warn(f"not on the map: {problem}; poses are in a frame of their own", RsUndistortWarning, stacklevel=4)
        return None, rec

    def _fitted(self, rec: Reconstruction, points: Array, targets: Array, sigma: Array) -> FittedSimilarity:
        """The similarity by places; if these do not determine the rotation, gimbals do: compasses err by more."""
        fit = fit_similarity(points, targets, sigma)
        if not (fit.sigma_rad < _MOST_TURN).all():
            fit = fit_similarity(points, targets, sigma, self._rotation(rec))
        common_up = 0.0 if self.holding else self.positions.common_up_m  # control points know better
        return replace(fit, sigma_m=np.hypot(fit.sigma_m, [0.0, 0.0, common_up]))

    def _rotation(self, rec: Reconstruction) -> tuple[Array, float] | None:
        """Rotation from a reconstruction's axes to the frame's by the gimbals, and its standard deviation; or None.

        The error of the compass is the same in all photos: many know it no better than one.
        """
        rotations = {
            name: R_cw
            for name, R_cw in zip(self.positions.names, self.positions.R_cw, strict=True)
            if name in self.places and np.isfinite(R_cw).all()
        }
        rows = [i for i, name in enumerate(rec.image_names) if name in rotations]
        if len(rows) < _LEAST:
            return None
        each = Rotation.from_matrix([rotations[rec.image_names[i]].T @ rec.R_cw[i] for i in rows])
        some = each[np.unique(np.linspace(0, len(rows) - 1, _SOME).astype(np.int64))]
        apart = np.array([(some * other.inv()).magnitude() for other in some])
        middle = some[int(np.argmin(np.median(apart, axis=1)))]
        near = (each * middle.inv()).magnitude() < _GIMBAL_OFF
        if 2 * near.sum() <= len(rows):  # they contradict each other
            return None
        return each[near].mean().as_matrix(), _GIMBAL_SIGMA

    def controlled(self, rec: Reconstruction, sigma_px: float) -> tuple[Survey | None, Reconstruction]:
        """The reconstruction with the control points among its points, in the frame that they define."""
        found = place_control(rec, self.holding)
        lost = [each.name for each in self.holding if each not in found.points]
        notes = [*self.notes]
        if lost:
            notes.append(f"control points that fewer than two registered photos see: {', '.join(lost)}")
        targets, sigma = stacked([(each.place_m, each.sigma_m) for each in found.points])
        survey, problem = self, f"{len(found.points)} control points are seen by registered photos, three are needed"
        if len(found.points) >= _LEAST:
            fit = self._fitted(rec, found.points_w, targets, sigma)
            problem = _misfit(fit, "control points", robust=False)
            if not problem:
                rec, survey = fit.similarity.of_reconstruction(rec), replace(self, fit=fit)
        if problem and self.fit is not None and found.points:
            notes.append(f"control points only move the model: {problem}")
            rec = Similarity(1.0, np.eye(3), (targets - found.points_w).mean(0)).of_reconstruction(rec)
        if problem and self.fit is None:
            said = f"not on the map: {problem}; poses are in a frame of their own"
            warnings.warn(said, RsUndistortWarning, stacklevel=4)
            return None, rec
        if self.places and found.points:
            # the common offset of all positions is the receiver's and its datum's, and control points know better
            centers, places, _ = _of_photos(rec, self.places)
            offset = np.median(centers - places, axis=0)
            moved = {name: (place + offset, sigma) for name, (place, sigma) in self.places.items()}
            survey = replace(survey, places=moved, gps_offset_m=self.gps_offset_m + offset)
        return replace(survey, notes=notes), with_control(rec, survey.holding, CONTROL_SIGMA_PX / sigma_px)

    def settled(self, rec: Reconstruction) -> tuple[Survey, Reconstruction]:
        """The adjusted reconstruction aligned with its places: the last steps of an adjustment need not move it."""
        x, y, sigma = _of_photos(rec, self.places)
        indices = {point_of(rec, each): each for each in self.holding}
        points = {k: each for k, each in indices.items() if k is not None}
        of_points = rec.points_w[list(points)], *stacked([(each.place_m, each.sigma_m) for each in points.values()])
        x, y, sigma = (np.concatenate(each) for each in zip((x, y, sigma), of_points, strict=True))
        fit = self._fitted(rec, x, y, sigma)
        rec = fit.similarity.of_reconstruction(rec)
        survey = replace(self, fit=fit)
        off = survey.outliers(rec)
        if off:
            rejected = ", ".join(f"{name} ({distance:.1f} m)" for name, distance in off.items())
            warnings.warn(f"GPS that is far off, and rejected: {rejected}", RsUndistortWarning, stacklevel=4)
        return survey, rec

    def outliers(self, rec: Reconstruction) -> dict[str, float]:
        """Photos whose GPS is far off, and its error, metres."""
        return {
            name: float(np.linalg.norm(residual))
            for name, (residual, deviation) in self._residuals(rec).items()
            if deviation > _MOST_OFF
        }

    def _residuals(self, rec: Reconstruction) -> dict[str, tuple[Array, float]]:
        """Centre less place of each photo, and the root mean square of that in standard deviations."""
        centers, places, sigma = _of_photos(rec, self.places)
        names = [name for name in rec.image_names if name in self.places]
        deviations = np.sqrt((((centers - places) / sigma) ** 2).mean(1))
        return dict(zip(names, zip(centers - places, deviations.tolist(), strict=True), strict=True))

    def georeference(
        self, rec: Reconstruction, covariances: Array, lengths: Sequence[KnownLength] = ()
    ) -> dict[str, Any]:
        """Its content of `solution.json`; covariances are those of the photos' unknowns."""
        assert self.fit is not None
        residuals = self._residuals(rec)
        off = self.outliers(rec)
        value: dict[str, Any] = {
            "crs": self.frame.crs,
            "origin": list(self.frame.origin),
            "target": self.frame.target,
            "transformation": self.frame.matrix.tolist(),
            "sigma": {
                "place_m": self.fit.sigma_m.tolist(),
                "rotation_deg": np.degrees(self.fit.sigma_rad).tolist(),
                "scale": self.fit.sigma_scale,
            },
            "notes": [*self.notes],
        }
        if residuals:
            apart = np.array([residual for residual, _ in residuals.values()])
            believed = np.array([name not in off for name in residuals])
            length = np.linalg.norm(apart, axis=1)
            value["gps"] = {
                "sigma_from": list(self.positions.sigma_from),
                "median_m": float(np.median(length)),
                "median_axes_m": np.median(np.abs(apart), axis=0).tolist(),
                "rms_axes_m": np.sqrt(np.mean(apart[believed] ** 2, axis=0)).tolist() if believed.any() else None,
                "offset_m": self.gps_offset_m.tolist(),
                "outliers": sorted(off),
                "photos": {
                    name: {"residual_m": residual.tolist(), "sigma_m": np.asarray(self.places[name][1]).tolist()}
                    for name, (residual, _) in residuals.items()
                },
            }
        if self.control:
            value["control"] = self._control(rec, covariances)
        value |= self._lengths(rec, lengths)
        return value

    def _control(self, rec: Reconstruction, covariances: Array) -> dict[str, Any]:
        """Control points by name: residual of the point where rays of the photos meet."""
        assert self.fit is not None
        found = place_control(rec, self.control, covariances if np.isfinite(covariances).all() else None)
        rows = {}
        for k, point in enumerate(found.points):
            variance = np.asarray(point.sigma_m) ** 2 + np.diagonal(found.covariance[k])
            if point.is_check:  # the frame is that of the others
                variance = variance + self.fit.variance_at(found.points_w[k : k + 1])[0]
            rows[point.name] = {
                "use": "check" if point.is_check else "control",
                "residual_m": (found.points_w[k] - point.place_m).tolist(),
                "sigma_m": np.sqrt(variance).tolist(),
                "rms_px": float(found.rms_px[k]),
                "photos": int(found.num_photos[k]),
            }
        return rows

    def _lengths(self, rec: Reconstruction, lengths: Sequence[KnownLength]) -> dict[str, Any]:
        """Ratio of known lengths in metres of the map to the given values, with a warning if they contradict it."""
        assert self.fit is not None
        lengths, _ = measured_lengths(rec, lengths)
        if not lengths:
            return {}
        ratio, sigma = scale_of_lengths(rec, lengths)
        sigma = float(np.hypot(sigma, self.fit.sigma_scale))
        if abs(np.log(ratio)) > _CONTRADICTS * sigma:
            warnings.warn(
                f"known lengths are {ratio:.4g} times as long on the map (+-{100 * sigma:.2g} %): the map's metres "
                "stay, and only their ratios are used; are the lengths in metres?", RsUndistortWarning, stacklevel=6,
            )  # fmt: skip
        return {"lengths": {"ratio": ratio, "sigma": sigma}}


def _of_photos(rec: Reconstruction, places: Mapping[str, tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Centres, places and standard deviations (k, 3) of the photos that have a place."""
    rows = [i for i, name in enumerate(rec.image_names) if name in places]
    return rec.center_w[rows], *stacked([places[rec.image_names[i]] for i in rows])


def _misfit(fit: FittedSimilarity, what: str, robust: bool = True) -> str:
    """Why places do not georeference a model; "" if they do."""
    if not (fit.sigma_rad < _MOST_TURN).all():
        return f"{what} along a line, or within its own errors, does not determine the rotation of the model"
    if not fit.sigma_scale < _MOST_SCALE:
        return f"{what} determines the scale to {100 * fit.sigma_scale:.0f} % only"
    if robust and np.median(fit.deviations) > _MOST_OFF:
        return f"{what} and the poses differ by {np.median(np.linalg.norm(fit.residuals, axis=1)):.1f} m in the median"
    return ""


def survey_of(
    crs: str | None,
    control: Sequence[ControlPoint],
    names: Sequence[str],
    facts: Sequence[ExifFacts],
    sizes: Sequence[tuple[int, int]],
    clock_s: Mapping[str, float] | None = None,
) -> Survey | None:
    """Known positions of photos, in the frame that was specified; None if that is arbitrary.

    Parameters
    ----------
    crs : str, optional
        "local", "none", or a projection for pyproj; None: local if GPS suffices, and no message if not.
    control : sequence of ControlPoint
        In that CRS; with "local" their frame is the map's.
    names, facts, sizes : sequences of length m
        Photos, what their EXIF says, and their (width, height).
    clock_s : mapping of name to float, optional
        As in `Survey`.

    Raises
    ------
    InputError
        The CRS was specified and too few photos have GPS, or too few control points are known; control points outside
        the photos, or far from them.
    """
    if crs == "none":
        if control:
            raise InputError("control points put the model on the map, and --crs none keeps it off; leave one out")
        return None
    _check_seen(control, dict(zip(names, sizes, strict=True)))
    positions = positions_of(names, facts)
    holding = [each for each in control if not each.is_check]
    if control and crs in (None, "local"):
        if len(holding) < _LEAST:
            raise InputError(f"{len(holding)} control points; three are needed, or --crs EPSG:... with the photos' GPS")
        unused = [f"GPS of {len(positions)} photos is not used: --crs says what the control points are in"]
        return Survey(MapFrame("control"), positions, {}, control, notes=unused * bool(len(positions)))
    few = f"{len(positions)} of {len(names)} photos have a GPS position; the map needs three"
    if len(positions) < _LEAST and len(holding) < _LEAST:
        if crs is not None:
            raise InputError(f"--crs {crs}: {few}{', or three control points (--gcp)' if crs != 'local' else ''}")
        if len(positions) or positions.notes:
            said = [few] * bool(len(positions)) + list(positions.notes)
            warnings.warn(f"not on the map: {'; '.join(said)}", RsUndistortWarning, stacklevel=4)
        return None
    if not len(positions):
        frame = frame_of_control(str(crs), np.array([each.place_m for each in holding]))
    else:
        frame = frame_at(crs or "local", positions.geodetic)
    placed = frame.of_geodetic(positions.geodetic) if len(positions) else np.zeros((0, 3))
    in_frame = [replace(each, place_m=frame.of_control(each.place_m)) for each in control]
    for each in in_frame:
        if len(placed) and np.linalg.norm(np.median(placed, axis=0)[:2] - each.place_m[:2]) > _ELSEWHERE_M:
            raise InputError(f"control point {each.name!r} lies far from the photos' GPS; is it in {crs}, E before N?")
    places = dict(zip(positions.names, zip(placed, positions.sigma_m, strict=True), strict=True))
    notes = [*positions.notes, *([frame.note] * bool(frame.note))]
    return Survey(frame, frame.rotated(positions), places, in_frame, clock_s=clock_s or {}, notes=notes)


def clocks_of(names: Sequence[str], camera_idx: Index, readouts: Readouts, cameras: PhotoCameras) -> dict[str, float]:
    """Readout times of photos whose direction was specified, by which GPS gives velocities."""
    known = {k: seconds for k, (seconds, _) in readouts.items() if cameras.readout_specified[k]}
    return {name: known[k] for name, k in zip(names, camera_idx.tolist(), strict=True) if k in known}


def _check_seen(control: Sequence[ControlPoint], sizes: Mapping[str, tuple[int, int]]) -> None:
    """Refuse control points in photos that do not exist, or outside them."""
    for point in control:
        for name, (x, y) in point.seen.items():
            if name not in sizes:
                raise InputError(f"control point {point.name!r}: {name!r} is not among the photos")
            width, height = sizes[name]
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                raise InputError(f"control point {point.name!r}: ({x:g}, {y:g}) is outside {name}, {width} x {height}")
