"""Results as a solution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..batch.rectify_options import RectifyOptions
from ..bundle import BundleResult, KnownMotions, ModelChoice, PoseCovariances, ReadoutChoice
from ..critical import Advice, Remedy
from ..input.photo_cameras import PhotoCameras
from ..model import BEND_GROUPS, Reconstruction, Solution, SolvedImage
from ..model.array_types import Array
from ..model.field import field_over_frame
from ..model.reprojection import reprojection_residuals
from ..rectify import largest_shift_px, steadiest_pinhole
from ..verdict import Verdict
from ..versions import versions
from .run_options import SolveOptions
from .survey import Survey

__all__ = ["Solved", "solution_of"]


@dataclass(frozen=True)
class Solved:
    """Results of a reconstruction, and remarks on them.

    Attributes
    ----------
    result : BundleResult
        Last adjustment.
    global_result : BundleResult
        A global-shutter adjustment of the same measurements, for comparison.
    cameras : PhotoCameras
        The cameras that it began with, and where they come from.
    choice : ModelChoice or None
        The choice of the model; None if it was specified.
    remedy : Remedy or None
        The remedy of a critical motion; None for a global shutter.
    advice : sequence of Advice
        Advice for the next shoot, if the poses are critical.
    directions : ReadoutChoice or None
        The readout directions by the measurements, if they were not specified.
    shared_ids : sequence of int
        Ids of the cameras that photos share, in all outputs, if not 1, 2, ...; if they vary, the photos' own are
        numbered.
    unregistered : mapping of name to reason
        Photos that are not in it.
    camera_of : mapping of name to camera index
        Cameras of photos, in it or not, as far as they are known.
    readouts : mapping of camera index to (seconds, source)
        Readout times, as far as they are known.
    whole : Reconstruction or None
        All frames of a video, whose key frames are the photos.
    evidence : mapping
        The readout time of a video in `solution.json`.
    facts : mapping
        Further options in `solution.json`.
    known_motions : KnownMotions or None
        What the photos say of motions that are known from elsewhere; those that they contradict were left out.
    poses : PoseCovariances or None
        Of the photos' poses.
    """

    result: BundleResult
    global_result: BundleResult
    cameras: PhotoCameras
    choice: ModelChoice | None = None
    remedy: Remedy | None = None
    advice: Sequence[Advice] = ()
    directions: ReadoutChoice | None = None
    verdict: Verdict | None = None
    shared_ids: Sequence[int] = ()
    unregistered: Mapping[str, str] = field(default_factory=dict)
    camera_of: Mapping[str, int] = field(default_factory=dict)
    readouts: Mapping[int, tuple[float, str]] = field(default_factory=dict)
    whole: Reconstruction | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    survey: Survey | None = None
    georeference: Mapping[str, Any] | None = None
    known_motions: KnownMotions | None = None
    poses: PoseCovariances | None = None

    @property
    def shared(self) -> Reconstruction:
        """The reconstruction with the cameras that photos share."""
        return self.result.reconstruction

    @property
    def reconstruction(self) -> Reconstruction:
        """The reconstruction with a camera for each photo, if they vary."""
        return self.shared.with_own_cameras()

    @property
    def camera_ids(self) -> list[int]:
        """Ids of the cameras of `reconstruction`, in all outputs."""
        own = self.shared.varies
        return list((not own and self.shared_ids) or range(1, 1 + len(self.reconstruction.cameras)))

    def camera_id_of(self, name: str) -> int:
        """Id in all outputs of the camera of a photo that is not in it.

        If cameras vary it is that of the first photo by the same one. Where nothing is known, it is the first.
        """
        k = self.camera_of.get(name, 0)
        if not self.shared.varies:
            return self.camera_ids[k]
        return self.camera_ids[int(np.argmax(self.shared.camera_idx == k))]

    def by_camera(self, values: Sequence[Any]) -> dict[str, Any]:
        """Values of shared cameras, by the ids of the outputs: those of the photos, if they vary."""
        of_photos = [values[k] for k in self.shared.camera_idx.tolist()]
        return dict(zip(map(str, self.camera_ids), of_photos if self.shared.varies else values, strict=True))


def _readouts(rec: Reconstruction, cameras: PhotoCameras) -> str | dict[str, str]:
    """Readout direction of all cameras, or by group if they differ."""
    directions = {label: camera.readout for label, camera in zip(cameras.labels, rec.cameras, strict=True)}
    return rec.cameras[0].readout if len(set(directions.values())) == 1 else directions


def _guesses(solved: Solved) -> list[str]:
    """Guesses of the cameras, and the result of the measurements, for people."""
    choice, cameras = solved.directions, solved.cameras
    # without a shutter no line is read before another: what fitted better was a lens that varies
    none = solved.verdict is not None and solved.verdict.shutter == "not-found"
    if choice is None or not choice.changed or none:
        return list(cameras.notes)
    return [
        f"{cameras.labels[k]} fits better as read out {choice.reconstruction.cameras[k].readout} "
        f"(by {choice.gain[k]:.0f} standard errors); --readout settles it"
        for k in choice.changed
    ]


def _image_rms(rec: Reconstruction) -> Array:
    """(m,) root mean square residual of each photo in pixels."""
    res, valid = reprojection_residuals(rec)
    frame = rec.observations.frame_idx[valid]
    square = np.bincount(frame, np.mean(res[valid] ** 2, axis=1), minlength=rec.num_images)
    return np.sqrt(square / np.maximum(np.bincount(frame, minlength=rec.num_images), 1))


def _critical(solved: Solved) -> dict[str, Any]:
    """Critical motions in `solution.json`."""
    remedy = solved.remedy
    assert remedy is not None
    after = remedy.after
    return {
        "singular_values": after.degeneracy.singular_values.tolist(),
        "null_vector": after.degeneracy.null_vector.tolist(),
        "y_axis_spread_deg": after.degeneracy.y_axis_spread_deg,
        "meaning": after.degeneracy.meaning,
        "sigma_log_k": after.sigma_log_k,
        "sigma_log_k_before": remedy.before.sigma_log_k,
        "weakest_sigma": after.weakest_sigma,
        "weakest_share": after.weakest_share,
        "flagged": after.is_flagged,
        "common_motion": after.common.as_json(),
        "remedy": remedy.name,
        "anchors": dict(remedy.anchors),
        "sentence": remedy.sentence,
        "warnings": list(remedy.warnings),
        "advice": [each.sentence for each in solved.advice],
    }


def _fields(solved: Solved) -> list[dict[str, float]]:
    """Size of the residual field of each camera: root mean square and largest over its frame, standard deviation."""
    lengths = [np.linalg.norm(field_over_frame(c)[1], axis=2) for c in solved.shared.cameras]
    sigmas = solved.result.sigma_fields_px
    return [
        {"rms_px": float(np.sqrt(np.mean(length**2))), "largest_px": float(length.max()), "sigma_px": sigma}
        for length, sigma in zip(lengths, sigmas, strict=True)
    ]


def solution_of(solved: Solved, options: SolveOptions, rectify: RectifyOptions) -> Solution:
    """The solution of an adjusted reconstruction, with every photo in it; its views are those of the raw photos."""
    rec, shared = solved.reconstruction, solved.shared
    return Solution(
        shutter_model=rec.shutter_model,
        cameras=dict(zip(map(str, solved.camera_ids), rec.cameras, strict=True)),
        # same size, and all but the same K, so that raw and rectified compare pixel by pixel
        rectified_cameras=solved.by_camera(
            [steadiest_pinhole(*each) for each in zip(shared.cameras, solved.cameras.cameras, strict=True)]
        ),
        images=tuple(_images(solved)),
        quality=_quality(solved),
        critical_motion=None if solved.remedy is None else _critical(solved),
        options={
            "camera": solved.cameras.source,
            "shutter_model": options.shutter_model,
            "readout": _readouts(shared, solved.cameras),
            "guesses": _guesses(solved),
            "seed": options.seed,
            "interpolation": rectify.interpolation,
            "quality": rectify.quality,
            "raw_as": rectify.raw_as,
            "refine": list(dict.fromkeys(name for each in solved.result.sigma_intrinsics for name in each)),
            "still": dict(options.still),
            "known": [] if _contradicted(solved) else sorted(options.known),
            "lengths": len(options.lengths),
            "remedy": options.remedy,
            "depth": str(rectify.depth),
            **solved.facts,
        },
        generator=versions(),
        verdict=None if solved.verdict is None else solved.verdict.to_json(),
        georeference=_georeference(solved),
    )


def _georeference(solved: Solved) -> Mapping[str, Any] | None:
    """The georeferencing, with the speeds of the cameras where the readout time is known."""
    if solved.georeference is None or solved.survey is None:  # then it is the model's
        return solved.georeference
    rec, positions = solved.shared, solved.survey.positions
    of_gps = zip(positions.names, positions.speed_m_s.tolist(), strict=True)
    by_gps = {name: speed for name, speed in of_gps if np.isfinite(speed)}
    known = solved.survey.known(rec)
    held = {} if known is None else known.velocities
    speeds = {}
    for i, name in enumerate(rec.image_names):
        readout = solved.readouts.get(int(rec.camera_idx[i]))
        if readout is None or rec.shutter_model != "constant-motion":
            continue
        per_second = rec.camera(i).frame_span / readout[0]
        velocity = rec.velocity[i] * per_second
        speed = float(np.linalg.norm(velocity))
        way = velocity / max(speed, 1e-300)
        sigma = per_second * float(np.sqrt(way @ solved.result.covariances[i, 9:12, 9:12] @ way))
        speeds[name] = {
            "velocity_m_s": velocity.tolist(),
            "speed_m_s": speed,
            "sigma_m_s": sigma,
            "gps_m_s": by_gps.get(name),
            "held_by_gps": name in held,
        }
    return {**solved.georeference, "speeds": speeds}


def _images(solved: Solved) -> Iterator[SolvedImage]:
    """Every photo, by name."""
    rec, verdict, keys = solved.reconstruction, solved.verdict, [str(key) for key in solved.camera_ids]
    doubtful, lens_only = ({}, ()) if verdict is None else (verdict.doubtful, verdict.lens_only)
    rms = _image_rms(rec)
    counts = np.bincount(rec.observations.frame_idx, minlength=rec.num_images)
    places = {name: i for i, name in enumerate(rec.image_names)}
    poses, none = solved.poses, [None] * rec.num_images
    sigma_rotation = none if poses is None else poses.sigma_rotation
    sigma_center = none if poses is None else poses.sigma_center(rec.R_cw, rec.baseline)
    for name in sorted([*rec.image_names, *solved.unregistered]):
        if name in solved.unregistered:
            yield SolvedImage(name, str(solved.camera_id_of(name)), reason=solved.unregistered[name])
            continue
        i = places[name]
        shift_px = largest_shift_px(rec.camera(i), rec.motion(i), rec.shutter_model) if name not in lens_only else 0.0
        yield SolvedImage(
            name=name,
            camera_id=keys[int(rec.camera_idx[i])],
            R_cw=rec.R_cw[i],
            center_w=rec.center_w[i],
            motion=rec.motion(i),
            sigma_phi=None if rec.shutter_model == "global" else solved.result.sigma_phi[i],
            sigma_rotation=sigma_rotation[i],
            sigma_center=sigma_center[i],
            num_observations=int(counts[i]),
            rms_px=float(rms[i]),
            rs_shift_px=shift_px,
            doubtful=doubtful.get(name),
            lens_only=name in lens_only,
        )


def _quality(solved: Solved) -> dict[str, Any]:
    """Accuracy of the results in `solution.json`."""
    result, shared = solved.result, solved.shared
    readouts = solved.by_camera([solved.readouts.get(k) for k in range(len(shared.cameras))])
    return {
        "num_points": shared.num_points,
        "num_observations": len(shared.observations),
        "rms_px": result.rms_px,
        "global_rms_px": solved.global_result.rms_px,
        **_held_out(solved.choice),
        **_known_motions(solved),
        "sigma_intrinsics": solved.by_camera(
            [each if k in shared.camera_idx else {} for k, each in enumerate(result.sigma_intrinsics)]
        ),
        "focal_sigma": result.focal_sigma,
        "centre_sigma_focal_lengths": result.centre_sigma,
        "lens_fields": solved.by_camera(_fields(solved)) if any(c.field.size for c in shared.cameras) else {},
        "phi_sigma_rad_per_frame": result.phi_sigma,
        **_bend_sigmas(result),
        "stop_reason": result.stop_reason,
        **({"readout_time": dict(solved.evidence)} if solved.evidence else {}),
        "readout_times": {k: {"ms": 1e3 * each[0], "source": each[1]} for k, each in readouts.items() if each},
    }


def _bend_sigmas(result: BundleResult) -> dict[str, Any]:
    """Prior standard deviations of the bends by group, of unsteady motions."""
    return {"bend_sigmas_rad": dict(zip(BEND_GROUPS, result.bend_sigmas, strict=False))} if result.bend_sigmas else {}


def _held_out(choice: ModelChoice | None) -> dict[str, Any]:
    """Evidence for the choice of the model, by model; empty if it was specified."""
    return {
        "held_out_rms_px": {} if choice is None else choice.held_out_rms_px,
        "held_out_error": {} if choice is None else choice.held_out_error,
        "held_out_gain": {} if choice is None else choice.gain,
        "held_out_kept": [] if choice is None else list(choice.kept),
        "held_out_chosen": None if choice is None else choice.label,
        "shared_travel": choice is not None and choice.is_shared,
        "held_out_left": {} if choice is None else choice.left,
        "agreement_of_halves": None if choice is None else choice.agreement,
    }


def _contradicted(solved: Solved) -> bool:
    """Whether the photos contradict motions that are known from elsewhere, so that these were left out."""
    return solved.known_motions is not None and solved.known_motions.is_contradicted


def _known_motions(solved: Solved) -> dict[str, Any]:
    """What the photos say of motions that are known from elsewhere."""
    known = solved.known_motions
    return {
        "known_motions_gain": None if known is None else known.gain,
        "known_motions_left_out": _contradicted(solved),
    }
