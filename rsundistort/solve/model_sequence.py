"""From features to poses, shutter motions and points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..bundle import (
    MODEL_SEQUENCE,
    BundleOptions,
    BundleResult,
    GuessedCameras,
    KnownMotions,
    ModelChoice,
    ReadoutChoice,
    bundle_adjust,
    choose_model,
    choose_readouts,
    judge_known_motions,
    pose_covariances,
)
from ..bundle.doubt import steps_after
from ..critical import Advice, Remedy, advise, heal, with_remedy
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..input.load import LoadedPhotos, OtherFeatures
from ..input.photo_cameras import PhotoCameras
from ..io.kept import Kept
from ..model import Camera, Reconstruction
from ..model.field import excess_px
from ..sfm import read_num_verified
from ..verdict import Verdict, judge
from .outcome import Solved
from .registering import Registrar, warn_of_left_out
from .solutions import consistent, num_of_one_scale
from .survey import Survey
from .track_sources import TrackSources
from .tracks import (
    TrackSource,
    adjusted_sequence,
    check_enough,
    is_strong,
    of_registered,
    retriangulated,
    rough_options,
    tell,
)

__all__ = ["solve_photos", "solve_tracks", "without_shutter"]

# Share of the photos that have no place from which on features of all are detected once more.
_WORTH = 0.1
# Where a shutter was not found, the principal point without one is not farther than this share of the frame from that
# with one, if both are the lens's: stabilised lenses move it by a few hundredths.
_NO_LENS = 0.1


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
    other: OtherFeatures | None = None,
    *,
    always_affine: bool = False,
) -> Solved:
    """Match, map and adjust the model sequence; then remove the shutter from keypoints, make new tracks and adjust.

    Parameters
    ----------
    shutter_model : str
        Last model of the sequence; "auto": up to rotation, then the model that best predicts held-out measurements.
    options_of : callable
        Options of the adjustments for a reconstruction, whose cameras have their readout directions.
    scratch : Path
        Folder for the database.
    remedy : str
        What to do about a critical motion, of `critical.REMEDIES`.
    matching : str
        Which photos are matched with each other, of `pairing.MATCHINGS`.
    workers : Workers, optional
        Workers that read the photos again, to align the tracks at full size; without them features keep their
        positions.
    survey : Survey, optional
        Positions of photos and control points: the frame is then that of the map.
    other : OtherFeatures, optional
        Features that photos get whose own ones match too few of others.
    always_affine : bool
        Whether photos that are left out are reason enough for affine features, without a strong shutter.
    """
    sources = TrackSources(photos, scratch, seed, log, matching, kept or Kept(), workers, other, always_affine)
    mapped, source = sources.mapped()
    check_enough(mapped, len(photos.names))
    num_verified = read_num_verified(source.matched)
    solved = solve_tracks(mapped, photos.cameras, shutter_model, seed, options_of, log, remedy, source, survey)
    lost = photos.unregistered(solved.shared.image_names, num_verified)
    solved = replace(solved, unregistered=lost, camera_of=photos.camera_of)
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
    solve = partial(
        solve_tracks, cameras=cameras, shutter_model=shutter_model, seed=seed, log=log, remedy=remedy, survey=survey
    )
    again = partial(solve, mapped, track_source=track_source)
    directions = _read_out(mapped, cameras, options_of(mapped), log)
    if directions is not None:
        mapped = directions.reconstruction
    wanted = with_remedy(options_of(mapped), remedy)
    if survey is not None:
        survey, mapped = survey.placed(mapped)
    if survey is not None:
        wanted = replace(wanted, places=survey.known(mapped))
    options = of_registered(wanted, mapped, says=track_source is None)
    auto = shutter_model == "auto"
    shutter_model = "rotation" if auto else shutter_model
    # an adjustment of new tracks follows, where there are any
    how = options if track_source is None else rough_options(options)
    result = adjusted_sequence(mapped, shutter_model, how, log)
    tracks, strong = result.reconstruction, is_strong(result.reconstruction)
    registrar = None if track_source is None else Registrar(track_source, wanted, log)
    if track_source is not None and registrar is not None:
        result, left_out = registrar.all_registered(result, again=survey is None)
        strong = strong or is_strong(result.reconstruction)
        more = _by_affine_features(track_source, result, partial(solve, options_of=options_of), strong)
        if more is not None:
            return more
        registrar, result, left_out = registrar.without_motions(result, left_out)
        track_source = registrar.track_source
        warn_of_left_out(left_out)
        options = of_registered(wanted, result.reconstruction)
        result, tracks, options = retriangulated(track_source, result, options, log, ends=not auto)
    options = replace(options, phi_sigma_start=result.phi_rms)
    choice = None
    if auto:
        choice, result, tracks, options = _chosen(track_source, result, tracks, options, seed, log)
    known_motions = _known_motions(result, shutter_model, options, seed) if choice is None else choice.known_motions
    if known_motions is not None and known_motions.is_contradicted:
        return _without(known_motions, again, options_of, log)
    if survey is not None and survey.holding:
        survey, result, options = _with_control(survey, result, options, log)
    result, mended, advice = _healed(result, options, remedy, log)
    global_result = _compared(result, options, log)
    log.begin("verdict")
    measured = mapped if track_source is None else tracks
    suspects = [] if registrar is None else registrar.suspects(result.reconstruction)
    verdict = judge(result, global_result, choice, mended, measured, options, strong, suspects, survey is not None)
    if verdict.lens_only:
        warnings.warn(_lens_only(verdict), RsUndistortWarning, stacklevel=3)
    log.end("verdict", shutter=verdict.shutter, shape=verdict.shape)
    poses = pose_covariances(result, options if mended is None else mended.added_to(options))
    solved = Solved(
        result, global_result, cameras, choice, mended, advice, directions, verdict, known_motions=known_motions,
        poses=poses,
    )  # fmt: skip
    return solved if survey is None else _on_the_map(solved, survey, options)


def _by_affine_features(
    track_source: TrackSource, result: BundleResult, solve: Callable[..., Solved], strong: bool
) -> Solved | None:
    """The solution of features that strong shutters leave as they are, if more photos have a place in it.

    A photo that is not registered has none, nor has one of a part that could be scaled against the rest.

    Without a strong shutter nothing speaks against the places that photos have, and those of the other must be the
    same: a photo that few points connect may scale a part of the scene.
    """
    total, num_placed = len(track_source.matched.names), num_of_one_scale(result.reconstruction)
    solved: Solved | None = None
    least = 1 if track_source.always_affine else max(_WORTH * total, 1) if strong else np.inf
    if track_source.of_affine is None or total - num_placed < least:
        return None
    # what is said of a solution that is not taken concerns nobody
    with suppress(ReconstructionError, InputError), warnings.catch_warnings(record=True) as said:
        mapped, source = track_source.of_affine(strong)
        solved = solve(mapped, track_source=source)
    if solved is None or num_of_one_scale(solved.shared) <= num_placed:
        return None
    if not (strong or consistent(result.reconstruction, solved.shared)):
        return None
    for each in said:
        warnings.warn(each.message, each.category, stacklevel=4)
    return solved


def _healed(
    result: BundleResult, options: BundleOptions, remedy: str, log: StageLog
) -> tuple[BundleResult, Remedy | None, list[Advice]]:
    """The solution after a critical motion was examined and mended, and advice for the next shoot."""
    if result.reconstruction.shutter_model == "global":
        return result, None, []
    log.begin("critical motion")
    result, mended = heal(result, options, remedy)
    for text in mended.warnings:
        warnings.warn(text, RsUndistortWarning, stacklevel=4)
    is_critical = mended.after.is_flagged or mended.after.common.is_weak
    advice = advise(result, mended.added_to(options)) if is_critical else []
    log.end("critical motion", remedy=mended.name, sigma_log_k=mended.after.sigma_log_k)
    return result, mended, advice


def _compared(result: BundleResult, options: BundleOptions, log: StageLog) -> BundleResult:
    """The stage that compares the solution with one of a global shutter."""
    log.begin("comparison with a global shutter")
    plain = without_shutter(result, options)
    log.end("comparison with a global shutter", rms_px=plain.rms_px)
    return plain


def _known_motions(result: BundleResult, model: str, options: BundleOptions, seed: int) -> KnownMotions | None:
    """What photos say of motions that are known from elsewhere, if the model of the shutter was specified."""
    if model == "global" or not options.known_phi:
        return None
    return judge_known_motions(result.reconstruction, model, options, sigma_px=result.sigma_px, seed=seed)


def _without(
    known_motions: KnownMotions, again: Callable[..., Solved], options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
) -> Solved:  # fmt: skip
    """The solution without the known motions, which the photos contradict: `again` solves with other options."""
    log.begin("without the known motions")
    log.end("without the known motions", gain=known_motions.gain, miss=known_motions.miss)
    solved = again(options_of=lambda rec: replace(options_of(rec), known_phi={}, known_bends={}))
    return replace(solved, known_motions=known_motions)


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
        options = replace(options, rival=steps_after(options.rival, result.reconstruction, tracks))
        result = bundle_adjust(tracks, shutter_model, options, partial(tell, log, "control points"))
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
    options = replace(
        options, varying=choice.varying, bends=choice.bends, residual_field=choice.residual_field, rival=choice.steps,
    )  # fmt: skip
    if choice.has_rival and _is_common(result, choice, options, log):
        choice = choice.with_velocity()
        options = replace(options, bends=choice.bends, rival=choice.steps)
    # windows were aligned, and outliers found, with a model that may be replaced now
    again = track_source is not None and track_source.workers is not None
    again = again and (choice.shutter_model == "constant-motion" or choice.bends > 0)
    start, how, outliers = tracks, rough_options(options), 0
    if not again:
        start, outliers = result.reconstruction, result.num_outliers
        how = replace(options, outlier_rounds=min(options.outlier_rounds, 1))
    start = replace(start, shutter_model=choice.shutter_model)
    result = bundle_adjust(start, choice.shutter_model, how, partial(tell, log, "choice"))
    cameras, why = _lens_instead(choice, result, start, options.guessed)
    if why:
        warnings.warn(why, RsUndistortWarning, stacklevel=4)
        held: dict[str, Any] = {"refine": (), "guessed": None, "varying": False, "residual_field": False}
        options, start = replace(options, **held), replace(start, cameras=cameras)
        result = bundle_adjust(start, choice.shutter_model, replace(how, **held), partial(tell, log, "choice"))
    result = replace(result, num_outliers=result.num_outliers + outliers)
    log.end(
        "choice of the model", chosen=choice.shutter_model, varying_lens=choice.varying, bends=choice.bends,
        residual_field=choice.residual_field, shutter=choice.shutter, agreement=choice.agreement, gain=choice.gain,
        num_held_out=choice.num_held_out,
    )  # fmt: skip
    if track_source is not None and again:
        result, tracks, options = retriangulated(track_source, result, options, log, ["alignment again"])
    return choice, result, tracks, options


def _is_common(result: BundleResult, choice: ModelChoice, options: BundleOptions, log: StageLog) -> bool:
    """Whether photos share a travel that held-out measurements do not show.

    Each photo's velocity may as well be a rotation, and hardly predicts measurements better. Of what photos share, the
    evidence says more; it takes an adjustment that knows its noise.
    """
    travelling = choice.with_velocity()
    if travelling is choice:
        return False
    own = replace(options, bends=travelling.bends, rival={}, outlier_rounds=min(options.outlier_rounds, 1))
    found = bundle_adjust(result.reconstruction, "constant-motion", own, partial(tell, log, "choice"))
    return found.common is not None and found.common.is_certain


def _lens_instead(
    choice: ModelChoice, found: BundleResult, start: Reconstruction, guessed: GuessedCameras | None
) -> tuple[Sequence[Camera], str]:
    """A lens in place of one that was found without a shutter and is none; and why, "" if it is one."""
    cameras, other = found.reconstruction.cameras, start.cameras
    if choice.shutter == "found":
        return cameras, ""
    # things that move, or photos that are misplaced: what neither lens nor shutter explains says nothing about a lens
    is_odd, is_other_odd = (
        guessed is not None
        and choice.unexplained_px(found.sigma_px) > 0
        and bool(guessed.surprises(each) or any(map(excess_px, each)))
        for each in (cameras, other)
    )
    moved = _is_no_lens(cameras, other)
    if guessed is not None and is_odd and (is_other_odd or not moved):
        assumed = [replace(guess, readout=each.readout) for each, guess in zip(cameras, guessed.cameras, strict=True)]
        return assumed, (
            "the photos contradict each other, and would need a lens that is not the camera's: they are corrected for "
            "the lens that was assumed before"
        )
    if moved and not is_other_odd:
        # it makes up for a shutter; that of the model which has one does not
        return other, (
            "without a shutter the photos would need a lens whose principal point lies far from that of any lens: they "
            "are corrected for the lens that the model with a shutter found"
        )
    return cameras, ""


def _is_no_lens(found: Sequence[Camera], start: Sequence[Camera]) -> bool:
    """Whether a camera's principal point went so far from where a shutter model has it that it is no lens any more."""
    return any(
        (np.abs(new.K[:2, 2] - old.K[:2, 2]) > _NO_LENS * np.array([new.width, new.height])).any()
        for new, old in zip(found, start, strict=True)
    )


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
