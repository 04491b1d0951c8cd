"""Tracks of photos by their motions: where new ones come from, and adjustments that converge with them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..bundle import BundleOptions, BundleResult, adjust_sequence, bundle_adjust, sequence_to
from ..errors import ReconstructionError, RsUndistortWarning
from ..input.load import LoadedPhotos
from ..input.patches import patch_source
from ..model import Reconstruction
from ..model.array_types import Array
from ..model.projection import unproject_points
from ..sfm import MatchedPhotos, align_tracks, firmly_connected, retriangulate
from .depth_reversal import choose_depths

__all__ = [
    "LEAST_PHOTOS",
    "NO_PARALLAX",
    "TrackSource",
    "adjusted_sequence",
    "check_enough",
    "is_strong",
    "of_registered",
    "retriangulated",
    "rough_options",
    "roughly_adjusted",
    "tell",
]

#: Photos that a shutter needs at least.
LEAST_PHOTOS = 3

# Re-triangulation ends when no rectified pixel of any photo moves by more than this between two rounds, in pixels of
# the images that the features were detected in; or when less than this share of the measurements changes, so that the
# tracks do not cause what still moves.
_SETTLED_PX = 0.2
_SETTLED_SHARE = 0.01
_MAX_ROUNDS = 4
# A photo that rotated by more during its readout, in radians, was mapped by thresholds that were not made for it: its
# pose may be wrong, and is checked with the points of the others.
_STRONG_RAD = 0.1
# Photos whose places lie within this share of the distance of the scene show hardly any parallax.
_NO_PARALLAX = 0.05
#: Said of them.
NO_PARALLAX = (
    "the photos overlap, but show no parallax: the camera stood still or only rotated; use photos from places apart"
)
# Places along each side of a photo where a change is measured.
_LOOKED_AT = 5


@dataclass(frozen=True)
class TrackSource:
    """Source of new tracks.

    Attributes
    ----------
    photos : LoadedPhotos or None
        The photos themselves.
    workers : Workers or None
        Workers that read them again to align the tracks at full size; None if that is not wanted.
    mapped_here : bool
        Whether the photos were mapped by us, in an arbitrary frame, so that they may be mapped once more. The frame of
        a model that somebody gave is kept.
    of_affine : callable or None
        Gives a mapping, and the source, of features that a strong shutter leaves as they are, by whether there is one;
        None if there are none.
    without_motions : callable or None
        Gives the source of features of the photos without the motions of a reconstruction; None if there are none.
    with_found_motions : callable or None
        Gives the source with features of photos that a scene of it lacks, without motions that they are found to have;
        None, or none, if there are none.
    rough_phi : mapping of name to (3,) array
        These motions, radians per unit of the clock.
    always_affine : bool
        Whether one photo that is left out is reason enough for these.
    """

    matched: MatchedPhotos
    photos: LoadedPhotos | None = None
    workers: Workers | None = None
    mapped_here: bool = False
    of_affine: Callable[[bool], tuple[Reconstruction, TrackSource]] | None = None
    without_motions: Callable[[Reconstruction], TrackSource] | None = None
    with_found_motions: Callable[[MatchedPhotos, Reconstruction, float], TrackSource | None] | None = None
    rough_phi: Mapping[str, Array] = field(default_factory=dict)
    always_affine: bool = False

    def aligned(self, reconstruction: Reconstruction, log: StageLog) -> Reconstruction:
        """The tracks of a reconstruction, aligned at full size."""
        assert self.photos is not None
        assert self.workers is not None
        names = reconstruction.image_names
        found = dict(zip(self.matched.names, self.matched.features, strict=True))
        source = patch_source(self.photos, names, self.workers, lambda done: log.tell("alignment", done, len(names)))
        return align_tracks(reconstruction, [found[name].step_px for name in names], source)


def tell(log: StageLog, stage: str, _cost: float) -> None:
    """The progress of an adjustment, as a stage of which nobody knows how far it is."""
    log.tell(stage, 0)


def of_registered(options: BundleOptions, mapped: Reconstruction, *, says: bool = True) -> BundleOptions:
    """Options without the constraints and lengths of photos that are not registered; a warning if it `says` so."""
    registered = set(mapped.image_names)
    lengths = [each for each in options.lengths if registered >= {each.start[0], each.end[0]}]
    # one alone determines only the scale of the world, which changes no photo
    lengths = lengths if len(lengths) > 1 else []
    if says and len(lengths) < len(options.lengths):
        apart = sorted({end[0] for each in options.lengths for end in (each.start, each.end)} - registered)
        rest = "those of the others are used" if lengths else "none is used, since ratios need two"
        warnings.warn(
            f"not registered, so no known length: {', '.join(apart)}; {rest}", RsUndistortWarning, stacklevel=3
        )
    lost = sorted({*options.held_phi, *options.known_phi, *options.still} - registered)
    if says and lost:
        warnings.warn(f"not registered, so no constraint: {', '.join(lost)}", RsUndistortWarning, stacklevel=3)
    return replace(
        options,
        lengths=lengths,
        held_phi={name: held for name, held in options.held_phi.items() if name not in lost},
        known_phi={name: known for name, known in options.known_phi.items() if name not in lost},
        still={name: still for name, still in options.still.items() if name not in lost},
    )


def rough_options(options: BundleOptions) -> BundleOptions:
    """Options of an adjustment that another one follows, which asks it for pixels and not for deviations."""
    return replace(
        options, outlier_rounds=2, cost_tolerance=1e-5, prior_sigma_rounds=1, prior_sigma_tolerance=0.05,
        deviations="model",
    )  # fmt: skip


def is_strong(rec: Reconstruction) -> bool:
    """Whether photos rotated by so much that mapping may have given them wrong poses."""
    return bool((np.linalg.norm(rec.phi, axis=1) * rec.frame_span()).max() > _STRONG_RAD)


def check_enough(registered: Reconstruction, total: int, before: Reconstruction | None = None) -> None:
    """Refuse too few photos for a shutter; photos that have tracks no more had no parallax, if they stand together."""
    if registered.num_images < LEAST_PHOTOS:
        if before is not None and np.linalg.norm(np.ptp(before.center_w, axis=0)) < _NO_PARALLAX * before.size:
            raise ReconstructionError(NO_PARALLAX)
        raise ReconstructionError(
            f"only {registered.num_images} of {total} photos could be registered, the shutter needs three; "
            "use photos that share more of the scene, or check the camera's focal length"
        )


def adjusted_sequence(
    mapped: Reconstruction, shutter_model: str, options: BundleOptions, log: StageLog
) -> BundleResult:
    """The solution of the model sequence; with strong rotations, the one whose depths are not reversed."""
    log.begin("model sequence")
    models = sequence_to(shutter_model)
    results = adjust_sequence(mapped, models, options, lambda model, _: log.tell(f"model sequence: {model}", 0))
    result = results[shutter_model]
    log.end(
        "model sequence",
        models=[{"model": k, "rms_px": r.rms_px, "iterations": r.num_iterations} for k, r in results.items()],
    )
    if not is_strong(result.reconstruction):
        return result
    log.begin("depths")
    depths = choose_depths(result, options, partial(tell, log, "depths"))
    log.end(
        "depths", reversed=depths.is_reversed, explained=depths.explained, explained_reversed=depths.explained_reversed
    )
    return depths.result


def roughly_adjusted(
    tracks: Reconstruction, result: BundleResult, wanted: BundleOptions, progress: Callable[[float], None]
) -> BundleResult:
    """An adjustment of other tracks after one, with its prior of the motions, that another one follows."""
    options = rough_options(of_registered(wanted, tracks, says=False))
    options = replace(options, phi_sigma_start=result.phi_rms)
    return bundle_adjust(tracks, tracks.shutter_model, options, progress)


def retriangulated(
    track_source: TrackSource, result: BundleResult, options: BundleOptions, log: StageLog, stages: Sequence[str] = (),
    ends: bool = True,
) -> tuple[BundleResult, Reconstruction, BundleOptions]:  # fmt: skip
    """Remove the shutter from keypoints, make new tracks and adjust, until the rectified photos converge.

    The last adjustment, its tracks, and the options without constraints of photos that are no longer registered. Only
    the last adjustment is exact, and only if it `ends` the solution: new tracks need pixels only.
    """
    shutter_model = result.reconstruction.shutter_model
    if not stages:
        stages = [f"re-triangulation {number}" for number in range(1, _MAX_ROUNDS + 1)]
        stages += ["alignment"] * (track_source.workers is not None)
    settled, aligns, found, drawn = False, False, None, None
    for stage in stages:
        aligns = stage.startswith("alignment")
        if settled and not aligns:
            continue
        log.begin(stage)
        before = result.reconstruction
        # points of two photos are for the alignment, which may find them in others
        drawn = drawn or retriangulate(track_source.matched, before, of_two=track_source.workers is not None)
        if aligns:
            tracks = track_source.aligned(drawn, log)
        else:
            tracks = drawn.with_points(np.ones(len(drawn.observations), bool), min_track=3)
            if (changed := _changed(found, tracks)) < _SETTLED_SHARE:
                log.end(stage, changed=changed)
                settled = True
                continue
        found, drawn = tracks, None
        tracks = firmly_connected(tracks)
        check_enough(tracks, len(track_source.matched.names), before)
        options = of_registered(options, tracks)
        options = replace(options, phi_sigma_start=result.phi_rms)
        how = options if ends and aligns else rough_options(options)
        result = bundle_adjust(tracks, shutter_model, how, partial(tell, log, stage))
        after = result.reconstruction
        moved = _moved_px(before, after)
        log.end(
            stage, points=after.num_points, observations=len(after.observations), rms_px=result.rms_px,
            iterations=result.num_iterations, stop_reason=result.stop_reason, moved_px=moved,
        )  # fmt: skip
        settled = moved < _SETTLED_PX * track_source.matched.step_px
    if ends and not aligns:
        result = bundle_adjust(tracks, shutter_model, options, partial(tell, log, "re-triangulation"))
    return result, tracks, options


def _moved_px(before: Reconstruction, after: Reconstruction) -> float:
    """Largest change of the rectified pixels of the same photos; inf if they are others."""
    if after.image_names != before.image_names:
        return np.inf
    return max(_change_px(before, after, i) for i in range(after.num_images))


def _change_px(before: Reconstruction, after: Reconstruction, image: int) -> float:
    """Largest change of a photo's rectified pixels."""
    camera = after.camera(image)
    across, down = (np.linspace(0, side - 1, _LOOKED_AT) for side in (camera.width, camera.height))
    xy = np.stack(np.meshgrid(across, down), axis=2).reshape(-1, 2)
    (old, seen), (new, still_seen) = (
        unproject_points(xy, rec.camera(image), rec.motion(image), rec.shutter_model) for rec in (before, after)
    )
    change = (new * camera.K[0, 0] - old * before.camera(image).K[0, 0])[seen & still_seen]
    return float(np.linalg.norm(change, axis=1).max(initial=0.0))


def _changed(before: Reconstruction | None, after: Reconstruction) -> float:
    """Share of a reconstruction's measurements that another lacks; 1 if that is of other photos."""
    if before is None or after.image_names != before.image_names:
        return 1.0
    old, new = (
        {(frame, *xy) for frame, xy in zip(obs.frame_idx.tolist(), obs.xy_raw.tolist(), strict=True)}
        for obs in (before.observations, after.observations)
    )
    return len(new - old) / max(len(new), 1)
