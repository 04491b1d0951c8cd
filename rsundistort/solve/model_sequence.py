"""From features to poses, shutter motions and points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..bundle import (
    MODEL_SEQUENCE,
    BundleOptions,
    BundleResult,
    ModelChoice,
    ReadoutChoice,
    adjust_sequence,
    bundle_adjust,
    choose_model,
    choose_readouts,
    sequence_to,
)
from ..critical import advise, heal, with_remedy
from ..errors import ReconstructionError, RsUndistortWarning
from ..input.load import LoadedPhotos
from ..input.patches import patch_source
from ..input.photo_cameras import PhotoCameras
from ..io.kept import Kept
from ..model import Reconstruction
from ..model.projection import unproject_points
from ..sfm import (
    MatchedPhotos,
    align_tracks,
    firmly_connected,
    map_without_motions,
    read_num_verified,
    register_photos,
    retriangulate,
)
from ..verdict import Verdict, judge
from .depth_reversal import choose_depths
from .outcome import Solved
from .placing import place_photos
from .solutions import agree, num_explained
from .survey import Survey

__all__ = ["TrackSource", "rough_options", "solve_photos", "solve_tracks", "without_shutter"]

# Re-triangulation ends when no rectified pixel of any photo moves by more than this between two rounds, in pixels of
# the images that the features were detected in; or when less than this share of the measurements changes, so that the
# tracks do not cause what still moves.
_SETTLED_PX = 0.2
_SETTLED_SHARE = 0.01
_MAX_ROUNDS = 4
# A photo that rotated by more during its readout, in radians, was mapped by thresholds that were not made for it: its
# pose may be wrong, and is checked with the points of the others.
_STRONG_RAD = 0.1
# Photos that a shutter needs at least.
_LEAST_PHOTOS = 3
# Rounds of registration: photos that are registered make others possible.
_MOST_WAVES = 4
# Places along each side of a photo where that is measured.
_LOOKED_AT = 5


@dataclass(frozen=True)
class TrackSource:
    """Source of new tracks.

    Attributes
    ----------
    matched : MatchedPhotos
        Their features and matches.
    photos : LoadedPhotos or None
        The photos themselves.
    workers : Workers or None
        Workers that read them again to align the tracks at full size; None if that is not wanted.
    mapped_here : bool
        Whether the photos were mapped by us, in an arbitrary frame, so that they may be mapped once more. The frame of
        a model that somebody gave is kept.
    """

    matched: MatchedPhotos
    photos: LoadedPhotos | None = None
    workers: Workers | None = None
    mapped_here: bool = False

    @property
    def step_px(self) -> float:
        """Pixels of the photos per pixel of the images that the features were detected in."""
        return float(np.median([each.step_px for each in self.matched.features]))

    def aligned(self, reconstruction: Reconstruction, log: StageLog) -> Reconstruction:
        """The tracks of a reconstruction, aligned at full size."""
        assert self.photos is not None
        assert self.workers is not None
        names = reconstruction.image_names
        found = dict(zip(self.matched.names, self.matched.features, strict=True))
        source = patch_source(self.photos, names, self.workers, lambda done: log.tell("alignment", done, len(names)))
        return align_tracks(reconstruction, [found[name].step_px for name in names], source)


def _tell(log: StageLog, stage: str, _cost: float) -> None:
    log.tell(stage, 0)


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


def _of_registered(options: BundleOptions, mapped: Reconstruction, *, says: bool = True) -> BundleOptions:
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


def _read_out(
    mapped: Reconstruction, cameras: PhotoCameras, options: BundleOptions, log: StageLog
) -> ReadoutChoice | None:
    """The readout directions that were not specified, by the measurements; None if all were."""
    guessed = {k: cameras.labels[k] for k in np.unique(cameras.camera_idx).tolist() if not cameras.readout_specified[k]}
    if not guessed:
        return None
    log.begin("readout")
    choice = choose_readouts(mapped, list(guessed), options, progress=lambda model, _: log.tell(f"readout: {model}", 0))
    log.end(
        "readout",
        directions={label: choice.reconstruction.cameras[k].readout for k, label in guessed.items()},
        gain_of_other_axis={guessed[k]: gain for k, gain in choice.gain.items()},
    )
    return choice


def solve_photos(
    photos: LoadedPhotos,
    shutter_model: str,
    seed: int,
    options_of: Callable[[Reconstruction], BundleOptions],
    scratch: Path,
    log: StageLog,
    remedy: str = "auto",
    matching: str = "auto",
    workers: Workers | None = None,
    kept: Kept | None = None,
    survey: Survey | None = None,
    finer: Callable[[], LoadedPhotos] | None = None,
) -> Solved:
    """Match, map and adjust the model sequence; then remove the shutter from keypoints, make new tracks and adjust.

    Parameters
    ----------
    photos : LoadedPhotos
        Features and cameras.
    shutter_model : str
        Last model of the sequence; "auto": up to rotation, then the model that best predicts held-out measurements.
    seed : int
        Seed of every random choice.
    options_of : callable
        Options of the adjustments for a reconstruction, whose cameras have their readout directions.
    scratch : Path
        Folder for the database.
    log : StageLog
        Gets the progress.
    remedy : str
        What to do about a critical motion, of `critical.REMEDIES`.
    matching : str
        Which photos are matched with each other, of `pairing.MATCHINGS`.
    workers : Workers, optional
        Workers that read the photos again, to align the tracks at full size; without them features keep their
        positions.
    kept : Kept, optional
        Results of an earlier run; takes those of this run.
    survey : Survey, optional
        Positions of photos and control points: the frame is then that of the map.
    finer : callable, optional
        As in `place_photos`.
    """
    cameras = photos.cameras
    mapped, matched = place_photos(
        photos, scratch, log, seed, matching, kept or Kept(), with_shutter=True, finer=finer
    )  # fmt: skip
    _check_enough(mapped, len(photos.names))
    solved = solve_tracks(
        mapped,
        cameras,
        shutter_model,
        seed,
        options_of,
        log,
        remedy,
        TrackSource(matched, photos, workers, mapped_here=True),
        survey,
    )
    if solved.survey is not None:
        return solved
    # the frame of a mapping is arbitrary
    return replace(solved, result=replace(solved.result, reconstruction=solved.shared.normalized()))


def solve_tracks(
    mapped: Reconstruction,
    cameras: PhotoCameras,
    shutter_model: str,
    seed: int,
    options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
    remedy: str = "auto",
    track_source: TrackSource | None = None,
    survey: Survey | None = None,
) -> Solved:
    """Adjust the model sequence from a global-shutter reconstruction, in its frame.

    Parameters
    ----------
    mapped : Reconstruction
        Poses, points and measurements.
    cameras : PhotoCameras
        Where its cameras come from.
    shutter_model, seed, options_of, log, remedy
        As in `solve_photos`.
    track_source : TrackSource, optional
        The matches behind it: new tracks are then made with the motions found, until these converge.
    survey : Survey, optional
        As in `solve_photos`.
    """
    directions = _read_out(mapped, cameras, options_of(mapped), log)
    if directions is not None:
        mapped = directions.reconstruction
    wanted = with_remedy(options_of(mapped), remedy)
    if survey is not None:
        survey, mapped = survey.placed(mapped)
    if survey is not None:
        wanted = replace(wanted, places=survey.known(mapped))
    options = _of_registered(wanted, mapped, says=track_source is None)
    auto = shutter_model == "auto"
    shutter_model = "rotation" if auto else shutter_model
    # an adjustment of new tracks follows, where there are any
    how = options if track_source is None else rough_options(options)
    result = _adjusted_sequence(mapped, shutter_model, how, log)
    tracks, strong = result.reconstruction, _is_strong(result.reconstruction)
    if track_source is not None:
        result = _all_registered(track_source, result, wanted, log, again=survey is None)
        strong = strong or _is_strong(result.reconstruction)
        options = _of_registered(wanted, result.reconstruction)
        result, tracks, options = _retriangulated(track_source, result, options, log, ends=not auto)
    options = replace(options, phi_sigma_start=result.phi_rms)
    choice = None
    if auto:
        choice, result, tracks, options = _chosen(track_source, result, tracks, options, seed, log)
    if survey is not None and survey.holding:
        survey, result, options = _with_control(survey, result, options, log)
    mended, advice = None, []
    if result.reconstruction.shutter_model != "global":
        log.begin("critical motion")
        result, mended = heal(result, options, remedy)
        for text in mended.warnings:
            warnings.warn(text, RsUndistortWarning, stacklevel=3)
        if mended.after.is_flagged or mended.after.common.is_weak:
            advice = advise(result, options)
        log.end("critical motion", remedy=mended.name, sigma_log_k=mended.after.sigma_log_k)
    log.begin("comparison with a global shutter")
    global_result = without_shutter(result, options)
    log.end("comparison with a global shutter", rms_px=global_result.rms_px)
    log.begin("verdict")
    measured = mapped if track_source is None else tracks
    known = {*options.known_phi, *options.held_phi, *options.still}
    # two standard deviations of the priors by exposure times
    most_phi = {name: 2.0 * limit for name, limit in options.phi_limits.items()}
    verdict = judge(result, global_result, choice, mended, measured, known, most_phi, strong)
    if verdict.lens_only:
        warnings.warn(_lens_only(verdict), RsUndistortWarning, stacklevel=3)
    log.end("verdict", shutter=verdict.shutter, shape=verdict.shape)
    solved = Solved(result, global_result, cameras, choice, mended, advice, directions, verdict)
    return solved if survey is None else _on_the_map(solved, survey, options)


def _adjusted_sequence(
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
    if not _is_strong(result.reconstruction):
        return result
    log.begin("depths")
    depths = choose_depths(result, options, partial(_tell, log, "depths"))
    log.end(
        "depths", reversed=depths.is_reversed, explained=depths.explained, explained_reversed=depths.explained_reversed
    )
    return depths.result


def _on_the_map(solved: Solved, survey: Survey, options: BundleOptions) -> Solved:
    """A georeferenced solution, aligned with its places, and remarks on it."""
    survey, rec = survey.settled(solved.shared)
    georeference = survey.georeference(rec, solved.result.covariances, options.lengths)
    return replace(solved, result=replace(solved.result, reconstruction=rec), survey=survey, georeference=georeference)


def _with_control(
    survey: Survey, result: BundleResult, options: BundleOptions, log: StageLog
) -> tuple[Survey | None, BundleResult, BundleOptions]:
    """The adjustment with control points; as it was if they do not fit it."""
    log.begin("control points")
    placed, tracks = survey.controlled(result.reconstruction, result.sigma_px)
    options = replace(options, places=None if placed is None else placed.known(tracks))
    if placed is not None:
        shutter_model = result.reconstruction.shutter_model
        result = bundle_adjust(tracks, shutter_model, options, partial(_tell, log, "control points"))
    log.end("control points", points=0 if placed is None else len(placed.holding))
    return placed, result, options


def _chosen(
    track_source: TrackSource | None, result: BundleResult, tracks: Reconstruction, options: BundleOptions, seed: int,
    log: StageLog,
) -> tuple[ModelChoice, BundleResult, Reconstruction, BundleOptions]:  # fmt: skip
    """The model that the measurements support, adjusted with all of them: its tracks and options."""
    log.begin("choice of the model")
    choice = choose_model(
        result.reconstruction, MODEL_SEQUENCE, options, sigma_px=result.sigma_px, seed=seed,
        progress=lambda model, _: log.tell(f"choice: {model}", 0),
    )  # fmt: skip
    options = replace(options, varying=choice.varying, bends=choice.bends, residual_field=choice.residual_field)
    # windows were aligned, and outliers found, with a model that may be replaced now
    again = track_source is not None and track_source.workers is not None
    again = again and (choice.shutter_model == "constant-motion" or choice.bends > 0)
    start, how, outliers = tracks, rough_options(options), 0
    if not again:
        start, outliers = result.reconstruction, result.num_outliers
        how = replace(options, outlier_rounds=min(options.outlier_rounds, 1))
    start = replace(start, shutter_model=choice.shutter_model)
    result = bundle_adjust(start, choice.shutter_model, how, partial(_tell, log, "choice"))
    result = replace(result, num_outliers=result.num_outliers + outliers)
    log.end(
        "choice of the model", chosen=choice.shutter_model, varying_lens=choice.varying, bends=choice.bends,
        residual_field=choice.residual_field, shutter=choice.shutter, agreement=choice.agreement, gain=choice.gain,
        num_held_out=choice.num_held_out,
    )  # fmt: skip
    if track_source is not None and again:
        result, tracks, options = _retriangulated(track_source, result, options, log, ["alignment again"])
    return choice, result, tracks, options


def without_shutter(result: BundleResult, options: BundleOptions) -> BundleResult:
    """The same measurements explained by a global shutter, for comparison."""
    if result.reconstruction.shutter_model == "global":
        return result
    plain = BundleOptions(
        outlier_rounds=0,
        loss="squared",
        cost_tolerance=1e-4,
        sigma_px=result.sigma_px,
        refine=options.refine,
        guessed=options.guessed,
        varying=options.varying,
        deviations="model",
    )
    return bundle_adjust(result.reconstruction, "global", plain)


def _lens_only(verdict: Verdict) -> str:
    """The photos whose motion is not corrected, for people."""
    count = len(verdict.lens_only)
    names = ", ".join(verdict.lens_only[:3]) + (", ..." if count > 3 else "")
    return (
        f"{count} photo{'s are' if count > 1 else ' is'} corrected for the lens only, since the measurements do not "
        f"support the motion found: {names}"
    )


def rough_options(options: BundleOptions) -> BundleOptions:
    """Options of an adjustment that another one follows, which asks it for pixels and not for deviations."""
    return replace(
        options, outlier_rounds=2, cost_tolerance=1e-5, prior_sigma_rounds=1, prior_sigma_tolerance=0.05,
        deviations="model",
    )  # fmt: skip


def _is_strong(rec: Reconstruction) -> bool:
    """Whether photos rotated by so much that mapping may have given them wrong poses."""
    return bool((np.linalg.norm(rec.phi, axis=1) * rec.frame_span()).max() > _STRONG_RAD)


def _check_enough(registered: Reconstruction, total: int) -> None:
    """Refuse too few photos for a shutter."""
    if registered.num_images < _LEAST_PHOTOS:
        raise ReconstructionError(
            f"only {registered.num_images} of {total} photos could be registered, the shutter needs three; "
            "use photos that share more of the scene, or check the camera's focal length"
        )


def _all_registered(
    track_source: TrackSource, result: BundleResult, wanted: BundleOptions, log: StageLog, *, again: bool
) -> BundleResult:
    """The solution with as many photos as can be registered; `again` by a second mapping, too, whose frame is another.

    A shutter that was strong before photos lost their poses is enough for that.
    """
    strong = _is_strong(result.reconstruction)
    result, left_out = _registered_again(track_source, result, wanted, log)
    strong = strong or _is_strong(result.reconstruction)
    if strong and again and track_source.mapped_here:
        result, left_out = _mapped_again(track_source, result, left_out, wanted, log)
    if left_out:
        names = ", ".join(sorted(left_out))
        warnings.warn(f"left out, since they contradict the other photos: {names}", RsUndistortWarning, stacklevel=4)
    return result


def _registered_again(
    track_source: TrackSource, result: BundleResult, wanted: BundleOptions, log: StageLog
) -> tuple[BundleResult, set[str]]:
    """Register photos that mapping left out, or gave a wrong pose without a shutter, with the points of the others.

    With it come those that lost their poses, since they contradict the others.
    """
    if result.reconstruction.shutter_model not in ("rotation", "constant-motion"):
        return result, set()
    matched, num_verified, left_out = track_source.matched, read_num_verified(track_source.matched), set[str]()
    for wave in range(1, _MOST_WAVES + 1):
        rec = result.reconstruction
        strong = _is_strong(rec)
        if not strong and rec.num_images == len(matched.names):
            break
        stage = f"registration {wave}"
        log.begin(stage)
        scene = firmly_connected(retriangulate(matched, rec))
        if strong and wave == 1 and scene.num_images >= _LEAST_PHOTOS:
            # thresholds without a shutter had cut off most measurements: no photo is judged before they are back
            result = _roughly_adjusted(scene, result, wanted, partial(_tell, log, stage))
            scene = firmly_connected(retriangulate(matched, result.reconstruction))
        found = register_photos(matched, num_verified, scene, strong=strong)
        changes = found.changes or scene.num_images < rec.num_images
        if changes:
            tracks = found.reconstruction
            if tracks.num_images >= _LEAST_PHOTOS:
                tracks = firmly_connected(retriangulate(matched, tracks))
            if tracks.num_images < _LEAST_PHOTOS:  # too few are connected to distinguish right from wrong
                log.end(stage, added=(), moved=(), dropped=())
                break
            result = _roughly_adjusted(tracks, result, wanted, partial(_tell, log, stage))
        left_out = left_out.union(found.dropped) - {*result.reconstruction.image_names}
        log.end(stage, added=found.added, moved=found.moved, dropped=found.dropped)
        if not changes:
            break
    return result, left_out


def _mapped_again(
    track_source: TrackSource, result: BundleResult, left_out: set[str], wanted: BundleOptions, log: StageLog
) -> tuple[BundleResult, set[str]]:
    """The solution, or that of a mapping of keypoints without rough motions if that has more photos.

    A side of a scene that mapping rotated as a whole has no photo that fits elsewhere. The cameras as they came and as
    they were found give two places to start from. The other solution must agree with the first one on the photos of
    both, and explain more measurements. With it come the photos that it left out, as of `_registered_again`.
    """
    rec, matched = result.reconstruction, track_source.matched
    if rec.shutter_model not in ("rotation", "constant-motion"):
        return result, left_out
    best, best_left_out, stage = result, left_out, "mapping without motions"
    for start in (matched, replace(matched, cameras=rec.cameras, calibrated=True)):
        if best.reconstruction.num_images == len(matched.names):
            break
        log.begin(stage)
        mapped = None
        with suppress(ReconstructionError):
            mapped = map_without_motions(start, result.phi_rms)
        log.end(stage, photos=0 if mapped is None else mapped.num_images)
        if mapped is None or mapped.num_images < _LEAST_PHOTOS:
            continue
        options = rough_options(_of_registered(wanted, mapped, says=False))
        other = _adjusted_sequence(mapped, rec.shutter_model, options, log)
        other, other_left_out = _registered_again(track_source, other, wanted, log)
        new, old = other.reconstruction, best.reconstruction
        more = new.num_images > rec.num_images and num_explained(new) > num_explained(old)
        if more and agree(rec, new):
            best, best_left_out = other, other_left_out
    return best, best_left_out


def _roughly_adjusted(
    tracks: Reconstruction, result: BundleResult, wanted: BundleOptions, progress: Callable[[float], None]
) -> BundleResult:
    """An adjustment of other tracks after one, with its prior of the motions, that another one follows."""
    options = rough_options(_of_registered(wanted, tracks, says=False))
    options = replace(options, phi_sigma_start=result.phi_rms)
    return bundle_adjust(tracks, tracks.shutter_model, options, progress)


def _retriangulated(
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
        _check_enough(tracks, len(track_source.matched.names))
        options = _of_registered(options, tracks)
        options = replace(options, phi_sigma_start=result.phi_rms)
        how = options if ends and aligns else rough_options(options)
        result = bundle_adjust(tracks, shutter_model, how, partial(_tell, log, stage))
        after = result.reconstruction
        moved = _moved_px(before, after)
        log.end(
            stage, points=after.num_points, observations=len(after.observations), rms_px=result.rms_px,
            iterations=result.num_iterations, stop_reason=result.stop_reason, moved_px=moved,
        )  # fmt: skip
        settled = moved < _SETTLED_PX * track_source.step_px
    if ends and not aligns:
        result = bundle_adjust(tracks, shutter_model, options, partial(_tell, log, "re-triangulation"))
    return result, tracks, options
