"""What was found, as a solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..batch.rectify_options import RectifyOptions
from ..bundle import BundleResult, ModelChoice
from ..input.photo_cameras import PhotoCameras
from ..model import BEND_GROUPS, Reconstruction, Solution, SolvedImage
from ..model.field import field_over_frame
from ..model.reprojection import reprojection_residuals
from ..rectify import largest_shift_px
from ..versions import versions
from .model_sequence import Solved
from .run_options import SolveOptions

__all__ = ["Outcome", "solution_of"]


@dataclass(frozen=True)
class Outcome:
    """What a reconstruction came to, and what is to be said beside it.

    Attributes
    ----------
    solved : Solved
        The reconstruction.
    cameras : PhotoCameras
        The cameras that it began with, and where they come from.
    shared_ids : sequence of int
        Of the cameras that photos share, in all outputs; where they vary, the photos' own are numbered.
    unregistered : mapping of name to reason
        Photos that are not in it.
    readouts : mapping of camera index to (seconds, source)
        Times of the readout, as far as they are known.
    options : mapping
        What else `solution.json` says of how it was made.
    """

    solved: Solved
    cameras: PhotoCameras
    shared_ids: Sequence[int]
    unregistered: Mapping[str, str] = field(default_factory=dict)
    readouts: Mapping[int, tuple[float, str]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reconstruction(self) -> Reconstruction:
        """With poses, motions and points, and a camera for each photo if they vary."""
        return self.solved.result.reconstruction.with_own_cameras()

    @property
    def camera_ids(self) -> list[int]:
        """Of the reconstruction's cameras, in all outputs."""
        rec = self.solved.result.reconstruction
        return list(range(1, 1 + rec.num_images)) if rec.varies else list(self.shared_ids)


def _by_camera(keys: Sequence[str], shared: Reconstruction, values: Sequence[Any]) -> dict[str, Any]:
    """What shared cameras have, by the ids of the outputs: those of the photos, if they vary."""
    of_photos = [values[k] for k in shared.camera_idx.tolist()]
    return dict(zip(keys, of_photos if shared.varies else values, strict=True))


def _readouts(rec: Reconstruction, cameras: PhotoCameras) -> str | dict[str, str]:
    """Direction of the readout of all cameras, or by group where they differ."""
    directions = {label: camera.readout for label, camera in zip(cameras.labels, rec.cameras, strict=True)}
    return rec.cameras[0].readout if len(set(directions.values())) == 1 else directions


def _guesses(solved: Solved, cameras: PhotoCameras) -> list[str]:
    """What was guessed of the cameras, and what the photos said of it, for people."""
    choice = solved.readouts
    found = [] if choice is None else choice.turned
    said = [] if found else list(cameras.notes)
    for k in found:
        assert choice is not None
        said.append(
            f"{cameras.labels[k]} fits better as read out {choice.reconstruction.cameras[k].readout} "
            f"(by {choice.gain[k]:.0f} standard errors); --readout settles it"
        )
    return said


def _image_rms(rec: Reconstruction) -> NDArray[np.float64]:
    """(m,) root mean square residual of each photo in pixels."""
    res, valid = reprojection_residuals(rec)
    frame = rec.observations.frame_idx[valid]
    square = np.bincount(frame, np.mean(res[valid] ** 2, axis=1), minlength=rec.num_images)
    return np.sqrt(square / np.maximum(np.bincount(frame, minlength=rec.num_images), 1))


def _critical(solved: Solved) -> dict[str, Any]:
    """What `solution.json` says of critical motions."""
    remedy = solved.remedy
    assert remedy is not None
    after = remedy.after
    return {
        "singular_values": after.meter.singular_values.tolist(),
        "null_vector": after.meter.null_vector.tolist(),
        "y_axis_spread_deg": after.meter.y_axis_spread_deg,
        "meaning": after.meter.meaning,
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
    """How large the residual field of each camera is: root mean square and largest over its frame, its deviation."""
    lengths = [np.linalg.norm(field_over_frame(c)[1], axis=2) for c in solved.result.reconstruction.cameras]
    sigmas = solved.result.sigma_fields_px
    return [
        {"rms_px": float(np.sqrt(np.mean(length**2))), "largest_px": float(length.max()), "sigma_px": sigma}
        for length, sigma in zip(lengths, sigmas, strict=True)
    ]


def solution_of(outcome: Outcome, options: SolveOptions, rectify: RectifyOptions) -> Solution:
    """The solution of an adjusted reconstruction, with every photo in it; its views are those of the raw photos."""
    solved, rec, verdict = outcome.solved, outcome.reconstruction, outcome.solved.verdict
    doubtful, lens_only = ({}, ()) if verdict is None else (verdict.doubtful, verdict.lens_only)
    rms = _image_rms(rec)
    counts = np.bincount(rec.observations.frame_idx, minlength=rec.num_images)
    keys = [str(key) for key in outcome.camera_ids]
    cameras = dict(zip(keys, rec.cameras, strict=True))
    shared = solved.result.reconstruction
    places = {name: i for i, name in enumerate(rec.image_names)}
    images = []
    for name in sorted([*rec.image_names, *outcome.unregistered]):
        if name in outcome.unregistered:
            images.append(SolvedImage(name, keys[0], reason=outcome.unregistered[name]))
            continue
        i = places[name]
        shift_px = largest_shift_px(rec.camera(i), rec.motion(i), rec.shutter_model) if name not in lens_only else 0.0
        images.append(
            SolvedImage(
                name=name,
                camera_id=keys[int(rec.camera_idx[i])],
                R_cw=rec.R_cw[i],
                center_w=rec.center_w[i],
                motion=rec.motion(i),
                sigma_phi=None if rec.shutter_model == "global" else solved.result.sigma_phi[i],
                num_observations=int(counts[i]),
                rms_px=float(rms[i]),
                rs_shift_px=shift_px,
                doubtful=doubtful.get(name),
                lens_only=name in lens_only,
            )
        )
    quality = {
        "num_points": rec.num_points,
        "num_observations": len(rec.observations),
        "rms_px": solved.result.rms_px,
        "global_rms_px": solved.global_result.rms_px,
        **_held_out(solved.choice),
        "sigma_intrinsics": _by_camera(keys, shared, solved.result.sigma_intrinsics),
        "focal_sigma": solved.result.focal_sigma,
        "centre_sigma_focal_lengths": solved.result.centre_sigma,
        "lens_fields": _by_camera(keys, shared, _fields(solved)) if any(c.field.size for c in shared.cameras) else {},
        "phi_sigma_rad_per_frame": solved.result.phi_sigma,
        **_bend_sigmas(solved.result),
        "stop_reason": solved.result.stop_reason,
        "readout_times": {
            key: {"ms": 1e3 * each[0], "source": each[1]}
            for key, each in _by_camera(
                keys, shared, [outcome.readouts.get(k) for k in range(len(shared.cameras))]
            ).items()
            if each is not None
        },
    }
    return Solution(
        shutter_model=rec.shutter_model,
        cameras=cameras,
        # same size and K, so that raw and rectified compare pixel by pixel
        rectified_cameras=_by_camera(keys, shared, [camera.pinhole() for camera in shared.cameras]),
        images=tuple(images),
        quality=quality,
        critical_motion=None if solved.remedy is None else _critical(solved),
        options={
            "camera": outcome.cameras.source,
            "shutter_model": options.shutter_model,
            "readout": _readouts(shared, outcome.cameras),
            "guesses": _guesses(solved, outcome.cameras),
            "seed": options.seed,
            "interpolation": rectify.interpolation,
            "quality": rectify.quality,
            "raw_as": rectify.raw_as,
            "refine": list(solved.result.sigma_intrinsics[0]),
            "still": dict(options.still),
            "known": sorted(options.known),
            "lengths": len(options.lengths),
            "remedy": options.remedy,
            "depth": str(rectify.depth),
            **outcome.options,
        },
        generator=versions(),
        verdict=None if verdict is None else verdict.to_json(),
    )


def _bend_sigmas(result: BundleResult) -> dict[str, Any]:
    """Spreads of the bends by group, of motions that are not steady."""
    return {"bend_sigmas_rad": dict(zip(BEND_GROUPS, result.bend_sigmas, strict=False))} if result.bend_sigmas else {}


def _held_out(choice: ModelChoice | None) -> dict[str, Any]:
    """What the model was chosen by, by model; empty where it was named."""
    return {
        "held_out_rms_px": {} if choice is None else choice.held_out_rms_px,
        "held_out_error": {} if choice is None else choice.held_out_error,
        "held_out_gain": {} if choice is None else choice.gain,
        "held_out_kept": [] if choice is None else list(choice.kept),
        "held_out_chosen": None if choice is None else choice.label,
        "held_out_left": {} if choice is None else choice.left,
        "agreement_of_halves": None if choice is None else choice.agreement,
    }
