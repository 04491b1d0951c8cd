"""One verdict on a solution, from all evidence for and against it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import stdtr

from ..bundle import BundleOptions, BundleResult, ModelChoice
from ..bundle.held_out import clipped_errors, corners, improves, standard_errors
from ..bundle.layout import motion_end
from ..critical import Remedy
from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.field import MOST_FIELD_PX, excess_px, fisheye_apart_px
from ..model.focal_lengths import zooms
from ..sfm import LEAST_MEASUREMENTS, LEAST_TIES, connected_photos
from .photos import PhotoMotions, hidden_px, photo_motions
from .residuals import left_along_readout, left_over_frame

__all__ = ["UNSEEN_PX", "Verdict", "height_reasons", "judge", "loose_reasons", "unexplained_reasons"]

#: Displacements below this are lost in the interpolation of a photo.
UNSEEN_PX = 1.0
_IF_FISHEYE = ' (of a fisheye, say "lens": "fisheye" in camera.json)'
# A motion with a larger standard deviation may do as much harm as good.
_UNCERTAIN_PX = 2.0
# Of the scene's height: as good as photos measure. No standard deviation includes errors that all photos share
# (docs/found.md).
_SMALL_PERCENT = 0.5
# Largest residual in the same places of all photos. A lens that makes motions wrong by half a pixel leaves 0.1 to 0.15
# even where cameras are rotated freely (k1 wrong by 0.03), and less where they are not.
_LEFT_PX = 0.1
# Standard deviations that the motion of some photo must exceed, root mean square over the frame: errors alone do so in
# one photo of 20 if one component decides, in one of 140 if all three do.
_EVIDENT = 2.0
# Fewer held-out measurements are not conclusive.
_LEAST_HELD_OUT = 30
# A photo is doubtful if its motion is this many times the prior standard deviation, if it has this few measurements, if
# these cover this share of its frame, or with this share of outliers.
_FAR = 5.0
# Upper quartile of the largest of three normal components, in their standard deviations.
_UPPER_QUARTILE = 1.69
_FEW = 2 * LEAST_MEASUREMENTS
_CORNER = 1 / 16
_OUTLIERS = 1 / 3
# A hand does not repeat itself: motions are the camera's if their mean is this many times their standard deviation, in
# this many photos, and by chance in one set of a thousand only.
_REPEATED, _LEAST_PHOTOS, _CHANCE = 2.0, 5, 0.001
# Rotations in common, in radians per unit of the clock, that no lens looks like: five standard deviations of the error
# that does, (cx, p2) = (3, 1) e (docs/found.md); about the other axes, pixels that are 1 % too long or 0.6 degrees from
# square.
_NO_LENS = 0.01
# Largest standard deviation of the direction of a photo whose pose counts as known, degrees.
_LOST_DEG = 1.0
# Said of a photo that may have a wrong place.
_SUSPECT = "its matches with the other photos contradict its place"
# Distance of a photo from the nearest other one, over the depth of what it shows, below which depths are hardly known:
# photos that were taken walking have 0.05 and more.
_NO_PARALLAX = 0.01
# Cosine between axes of rotation that count as the same.
_SAME_WAY = 0.9


@dataclass(frozen=True)
class Verdict:
    """How far a solution can be trusted.

    Attributes
    ----------
    shutter : str
        "found" (evidence for a rolling shutter that can be seen), "not-found" (none that can be seen), or
        "not-determined" (the photos do not determine it).
    shape : str
        "trusted", or "doubtful" if there is any reason against it.
    reasons : tuple of str
        Reasons against it, in sentences.
    doubtful : mapping of photo name to reason
        Photos whose motion should be checked.
    lens_only : tuple of str
        Photos whose motion is not to be corrected, since their measurements do not support it: all of them if the
        evidence that chose the model does not hold.
    """

    shutter: str
    shape: str
    reasons: tuple[str, ...] = ()
    doubtful: Mapping[str, str] = field(default_factory=dict)
    lens_only: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The content of `Solution.verdict`: of the whole; the photos have their own."""
        return {"shutter": self.shutter, "shape": self.shape, "reasons": list(self.reasons)}


def judge(
    result: BundleResult,
    global_result: BundleResult | None = None,
    choice: ModelChoice | None = None,
    remedy: Remedy | None = None,
    tracks: Reconstruction | None = None,
    options: BundleOptions | None = None,
    strong: bool = False,
    suspects: Collection[str] = (),
    scaled: bool = False,
) -> Verdict:
    """Judge a solution.

    Parameters
    ----------
    global_result : BundleResult, optional
        A global-shutter adjustment of the same measurements, to compare a model that the user named with.
    choice : ModelChoice, optional
        The choice of the model; None if the user named it.
    remedy : Remedy, optional
        The remedy of a critical motion, with the uncertainty of the height of the scene; None for a global shutter.
    tracks : Reconstruction, optional
        The measurements before outliers were dropped.
    options : BundleOptions, optional
        Of the adjustment: the motions that are known from elsewhere, and need no support, and the limits by exposure
        times. Without them, photos that show no shutter are not asked whether they would show one.
    strong : bool
        Whether photos rotated so much during the readout that mapping, which knows no shutter, may have given them
        wrong poses: only the solution then determines these.
    suspects : collection of photo names
        Photos whose place their matches with the others contradict.
    scaled : bool
        Whether more than points determines the scale of each part of the scene: positions of photos, or a path.

    Returns
    -------
    Verdict
        "trusted" only if there is no reason against it.
    """
    rec = result.reconstruction
    unexplained = unexplained_reasons(result, choice)
    reasons = loose_reasons(result, scaled) + height_reasons(remedy) + unexplained
    if suspects:
        reasons.append(f"{len(suspects)} of {rec.num_images} photos may have a wrong place ({', '.join(suspects)}).")
        reasons += _no_parallax(rec)
    if rec.shutter_model == "global":
        shutter, why = _of_global(result, choice, options)
        doubts = _of_measurements(rec, _outliers(rec, tracks))
        left = bool(unexplained) or (choice is not None and bool(choice.against))
        _doubt_poses(doubts, _misplaced(result, left) if strong else {}, suspects)
        return _verdict(shutter, reasons + why, _texts(doubts))
    given = options or BundleOptions()
    known = {*given.known_phi, *given.held_phi, *given.still}
    motions, outliers = photo_motions(result), _outliers(rec, tracks)
    doubts = _doubts(result, motions, outliers, given.phi_limits)
    # the fixed scene draws both halves to the motion that it was solved with: their difference is less than the error
    torn = (motions.difference_px > np.maximum(UNSEEN_PX, motions.shift_px / 2)) | (outliers > 0.5)
    # a motion that may as well be none: with an error of its size, one photo in three comes out worse than it was; a
    # model that the user named is applied where there are measurements
    unsupported = (motions.relative_sigma >= 1.0) & ((_counts(rec) < _FEW) | (choice is not None))
    unsupported &= ~np.isin(rec.image_names, [*known])
    shutter, why = _of_motions(result, global_result, choice, motions, torn, unsupported, known, options)
    reasons += _rival_reasons(choice)
    _doubt_poses(doubts, _misplaced(result, bool(unexplained + why)) if strong else {}, suspects)
    reasons += why
    if not reasons:
        reasons = _of_photos(rec, doubts, motions)
    for name, said in _faint(rec, motions).items():
        doubts[name].append(said)
    # pose and motion are one estimate: what contradicts the one does not support the other
    lost = torn | np.isin(rec.image_names, [*suspects])
    lost |= unsupported
    # motions that cannot be seen do no harm
    lost &= motions.shift_px >= UNSEEN_PX
    # a model that the user named is applied
    lost |= shutter == "not-determined" and choice is not None
    lens_only = tuple(name for name, each in zip(rec.image_names, lost, strict=True) if each and name not in known)
    return _verdict(shutter, reasons, _texts(doubts), lens_only)


def _verdict(
    shutter: str, reasons: list[str], doubtful: Mapping[str, str] | None = None, lens_only: tuple[str, ...] = ()
) -> Verdict:
    return Verdict(shutter, "doubtful" if reasons else "trusted", tuple(reasons), doubtful or {}, lens_only)


def _counts(rec: Reconstruction) -> Index:
    return np.bincount(rec.observations.frame_idx, minlength=rec.num_images)


def _outliers(rec: Reconstruction, tracks: Reconstruction | None) -> Array:
    """(m,) share of each photo's measurements that the solution does not explain."""
    if tracks is None:
        return np.zeros(rec.num_images)
    before = dict(zip(tracks.image_names, _counts(tracks).tolist(), strict=True))
    return 1.0 - _counts(rec) / np.maximum([before.get(name, 0) for name in rec.image_names], 1)


def loose_reasons(result: BundleResult, scaled: bool = False) -> list[str]:
    """Parts of the scene without a common scale: the equations then have no single solution."""
    rec = result.reconstruction
    loose = ~connected_photos(rec, LEAST_TIES, in_common=2)
    if loose.any() and not scaled:
        names = ", ".join(np.array(rec.image_names)[loose].tolist())
        return [
            f"Parts of the scene could be scaled against each other, since {loose.sum()} of {rec.num_images} photos "
            f"show fewer than {LEAST_TIES} points that two of the others show; take more photos between the others and "
            f"these ({names})."
        ]
    if np.isfinite(result.covariances).all():
        return []
    weakest = rec.image_names[int(np.argmin(_counts(rec)))]
    return [
        "So few measurements connect the photos that parts of the scene could be scaled against each other; take more "
        f"photos between them ({weakest} has the fewest measurements)."
    ]


def height_reasons(remedy: Remedy | None) -> list[str]:
    """A too large uncertainty of the height of the scene."""
    if remedy is None:
        return []
    cost = remedy.after
    if cost.degeneracy.is_low and remedy.name == "none":
        return [
            "The cameras were not rotated against each other, so the height of the scene is undetermined, and the "
            "remedy is switched off."
        ]
    contradicted = [f"{text}." for text in remedy.contradictions]
    if not 100 * cost.sigma_log_k <= _SMALL_PERCENT:
        return [*contradicted, f"{cost.sentence[0].upper()}{cost.sentence[1:]}."]
    return contradicted


def unexplained_reasons(result: BundleResult, choice: ModelChoice | None) -> list[str]:
    """Reasons in the residuals against the solution."""
    reasons = []
    if (left := left_over_frame(result.reconstruction)) >= _LEFT_PX:
        reasons.append(
            f"In the same places of all photos {left:.2f} px remain unexplained: the lens model does not fit the lens."
        )
    elif (left := left_along_readout(result.reconstruction)) >= _LEFT_PX:
        reasons.append(
            f"At the same times of the readout {left:.2f} px remain unexplained: the model of the lens, or of the "
            "motion during the readout, does not fit."
        )
    if (size := max(map(excess_px, result.reconstruction.cameras))) > 0:
        # a fisheye of a narrower view is a pinhole lens
        may_be = any(
            each.lens == "pinhole" and excess_px(each) > 0 and fisheye_apart_px(each) > MOST_FIELD_PX
            for each in result.reconstruction.cameras
        )
        reasons.append(
            f"The photos deviate from the lens model by {size:.1f} px in the mean, more than any lens of its kind: it "
            f"is not the model of this lens{_IF_FISHEYE if may_be else ''}."
        )
    if choice is not None:
        if choice.restless:
            reasons.append(
                "The lines of the photos move faster than the motions that are modelled: the camera shook at more than "
                "five periods a frame, or the photos were stabilised line by line."
            )
        if zoomed := _zoomed(result.reconstruction):
            reasons.append(
                f"The focal length would have to vary more than by focusing, {zoomed}: photos of another zoom, or of "
                "another camera, are among these; give them a camera of their own (cameras.json)."
            )
        if (beyond_px := choice.unexplained_px(result.sigma_px)) > 0:
            reasons.append(
                f"Held-out measurements are off by {beyond_px:.1f} px more than their noise explains; exclude what "
                "moves, if it is large (--masks)."
            )
    return reasons


def _no_parallax(rec: Reconstruction) -> list[str]:
    """Whether photos were taken so near to each other that hardly any depth is known."""
    # the nearest is the photo itself
    nearest, _ = cKDTree(rec.center_w).query(rec.center_w, k=[2])
    share = float(np.median(nearest) / rec.typical_depth)
    if not share < _NO_PARALLAX:
        return []
    return [
        f"Most photos were taken nearly from where another one was ({100 * share:.1f} % of the depth apart), so that "
        "their depths are hardly known: walk between photos."
    ]


def _zoomed(rec: Reconstruction) -> str:
    """From where to where focal lengths of a camera vary, if they lie too far apart for one that focuses; else ""."""
    for k in range(len(rec.cameras)):
        focal = np.array([rec.camera(i).K[0, 0] for i in np.flatnonzero(rec.camera_idx == k).tolist()])
        if len(zooms(focal)) > 1:
            return f"from {focal.min():.0f} to {focal.max():.0f} px"
    return ""


def _rival_reasons(choice: ModelChoice | None) -> list[str]:
    """Whether the photos may have been displaced by a velocity, and not by the rotations that were found."""
    if choice is None or not choice.shows_rival:
        return []
    return [
        "A camera that travels explains the photos as well as one that rotates, and would displace pixels elsewhere, "
        f"by {choice.rival:.1f} times of what is corrected: give --model constant-motion if it travelled, or --model "
        "rotation if it did not."
    ]


def _of_global(
    result: BundleResult, choice: ModelChoice | None, options: BundleOptions | None
) -> tuple[str, list[str]]:
    """Whether there may be a shutter that was not corrected, and why."""
    if choice is None:
        return "not-determined", ["The shutter was not examined, as you asked (--model global)."]
    if choice.num_held_out < _LEAST_HELD_OUT:
        return "not-determined", [
            f"There are too few measurements to detect a rolling shutter: only {choice.num_held_out} could be held out."
        ]
    if choice.shutter == "not-determined":
        return choice.shutter, [
            "A rolling shutter would explain a part of what bends the photos, and was not corrected: "
            f"{'; '.join(choice.against)}."
        ]
    if choice.shutter == "not-found" and (why := _unshown(result, options)):
        return "not-determined", why
    return choice.shutter, []


def _unshown(result: BundleResult, options: BundleOptions | None) -> list[str]:
    """Whether photos that show no shutter would show one."""
    if options is None or (hidden := hidden_px(result, options)) <= _UNCERTAIN_PX:
        return []
    size = f" that displaces pixels by {hidden:.1f} px (one standard deviation)" if np.isfinite(hidden) else ""
    return [
        f"These photos would not show a rolling shutter{size}, so whether there is one is not known; take more photos "
        "that show the same points."
    ]


def _of_motions(
    result: BundleResult,
    global_result: BundleResult | None,
    choice: ModelChoice | None,
    motions: PhotoMotions,
    torn: Mask,
    unsupported: Mask,
    known: Collection[str],
    options: BundleOptions | None,
) -> tuple[str, list[str]]:
    """Whether a shutter was found, and why not."""
    rec = result.reconstruction
    seen = motions.shift_px >= UNSEEN_PX
    if not seen.any():
        why = [] if choice is None else _unshown(result, options)
        return ("not-determined" if why else "not-found"), why
    reasons = []
    if choice is None and not (global_result is not None and _explains(result, global_result)):
        reasons.append(
            f"The {rec.shutter_model} model, which you named, explains no more than it leaves unexplained: its "
            "motions may be an error of the lens."
        )
    if (alike := _repeated(rec, options)) is not None and not {*known}.issuperset(rec.image_names):
        axis, rotation = alike
        travel = "" if rec.shutter_model == "constant-motion" else ", or a camera that travels over flat ground"
        reasons.append(
            f"All photos{' of a camera' if len(rec.cameras) > 1 else ''} appear to have rotated alike, by "
            f"{np.degrees(abs(rotation)):.2f} degrees about {'xyz'[axis]}, as no hand does: an error of the lens looks "
            f"like that{travel}{' (--model constant-motion)' if travel else ''}."
        )
    by_known = None if choice is None else choice.known_motions
    measured = by_known is not None and by_known.is_better
    if choice is not None and not measured and any(map(excess_px, rec.cameras)):
        reasons.append("What bends the photos may be their lens.")
    if 2 * torn.sum() > rec.num_images and not measured:
        reasons.append("In most photos halves of the measurements do not agree on the motion found.")
    elif (torn & ~np.isin(rec.image_names, [*known]))[seen].all() and not measured:
        shown = ", ".join(np.array(rec.image_names)[seen].tolist())
        reasons.append(
            f"Only {shown} would show a shutter, and most of what that shows contradicts the rest or itself."
        )
    evident = (_EVIDENT * motions.relative_sigma < 1.0) | np.isin(rec.image_names, [*known])
    # photos together show what none of them does alone
    evident |= result.common is not None and result.common.is_certain
    if unsupported[seen].all():
        reasons.append("No photo's motion is larger than its standard deviation.")
    elif choice is not None and not evident[seen].any():
        reasons.append(f"No photo's motion is larger than {_EVIDENT:.0f} standard deviations.")
    return ("not-determined" if reasons else "found"), reasons


def _explains(result: BundleResult, global_result: BundleResult) -> bool:
    """Whether a model explains its measurements better than a global shutter does, as a chosen one must."""
    rec, plain = result.reconstruction, global_result.reconstruction
    if len(plain.observations) != len(rec.observations):
        return False
    # errors of fitted measurements, which noise alone makes smaller than 1 by half of each unknown: added to compare
    # with 1
    num = len(rec.observations)
    before, after = (
        clipped_errors(each, each.observations, result.sigma_px)[0]
        + (motion_end(each.shutter_model) * each.num_images + 3 * each.num_points) / (2 * num)
        for each in (plain, rec)
    )
    return improves(before, after, standard_errors(before - after, corners(rec, rec.observations)))


def _repeated(rec: Reconstruction, options: BundleOptions | None = None) -> tuple[int, float] | None:
    """The axis of a camera about which all its photos rotated alike and visibly, and by how much; None if none did.

    None also if the camera rotated so from photo to photo, too: then it panned; or if they rotated by more than a lens
    could feign, of a camera that is what it was expected to be: a focal length that is wrong by a fifth makes up for as
    much in common.
    """
    guessed = None if options is None else options.guessed
    most = np.inf if guessed is not None and guessed.surprises(rec.cameras) else _NO_LENS
    found = (_repeated_of(k, rec, most) for k in range(len(rec.cameras)))
    return next((each for each in found if each is not None), None)


def _repeated_of(camera: int, rec: Reconstruction, most: float) -> tuple[int, float] | None:
    """The same of one camera, below a rotation per unit of the clock."""
    mine = np.flatnonzero(rec.camera_idx == camera)
    m = len(mine)
    if m < _LEAST_PHOTOS:
        return None
    phi, R_cw = (rec.phi * rec.frame_span()[:, None])[mine], rec.R_cw[mine]
    half_px = float(rec.cameras[camera].K[0, 0]) / 2
    between = Rotation.from_matrix(R_cw[1:] @ R_cw[:-1].transpose(0, 2, 1)).as_rotvec().mean(0)
    # vibration is each photo's own, too: as much as a steady rotation over the frame of the same mean square
    bend = rec.bend[mine][:, :, :3]
    own = np.sqrt(12.0 * ((bend - bend.mean(0)) ** 2).mean((0, 1))) if rec.bends else np.zeros(3)
    # of all photos; and without the largest and smallest fifth, since photos that came out wrong hide what the others
    # have in common
    for trimmed in (0, m // 5):
        mean, spread, freedom = _trimmed_mean(phi, trimmed)
        per_clock = np.abs(_trimmed_mean(rec.phi[mine], trimmed)[0])
        if between @ mean > _SAME_WAY * np.linalg.norm(between) * np.linalg.norm(mean):
            continue
        chance = 2.0 * stdtr(freedom, -np.abs(mean) / np.maximum(spread, 1e-12) * np.sqrt(m))
        alike = np.abs(mean) > _REPEATED * np.hypot(spread, own)
        alike &= (3 * chance < _CHANCE) & (np.abs(mean) * half_px > UNSEEN_PX)
        alike &= per_clock < most
        if alike.any():
            axis = int(np.argmax(np.where(alike, np.abs(mean), 0.0)))
            return axis, float(np.mean(phi[:, axis]))
    return None


def _trimmed_mean(values: Array, trimmed: int) -> tuple[Array, Array, int]:
    """Mean of columns (m, k) without so many values at either end, its standard deviation times sqrt(m), its freedom.

    The deviation is Tukey and McLaughlin's, from the Winsorised variance.
    """
    m = len(values)
    ordered = np.sort(values, axis=0)
    kept = ordered[trimmed : m - trimmed]
    winsorised = np.clip(ordered, kept[0], kept[-1])
    return kept.mean(0), winsorised.std(0, ddof=1) * m / len(kept), len(kept) - 1


def _doubts(
    result: BundleResult, motions: PhotoMotions, outliers: Array, phi_limits: Mapping[str, float]
) -> dict[str, list[str]]:
    """Reasons against each photo, of limits that are standard deviations."""
    rec = result.reconstruction
    rotation = rec.phi * rec.frame_span()[:, None]
    sigma = np.linalg.norm(result.sigma_phi, axis=1) * rec.frame_span()
    times = _times_usual(rec, result.phi_rms)
    doubts = _of_measurements(rec, outliers)
    for i, said in enumerate(doubts.values()):
        if motions.covered[i] < _CORNER:
            said.append(f"its measurements lie in {100 * motions.covered[i]:.0f} % of its frame")
        if motions.difference_px[i] > UNSEEN_PX:
            said.append(f"its halves contradict each other by {motions.difference_px[i]:.1f} px")
        if times[i] > _FAR and motions.shift_px[i] > UNSEEN_PX:
            said.append(f"it moved {times[i]:.0f} times as much as the other photos do")
        most = 2 * phi_limits.get(rec.image_names[i], np.inf)
        if np.linalg.norm(rotation[i]) - 2 * sigma[i] > most:
            said.append(
                f"it appears to have rotated by {np.degrees(np.linalg.norm(rotation[i])):.2f} degrees, but would be "
                f"blurred by more than {np.degrees(most):.2f}"
            )
    return doubts


def _of_measurements(rec: Reconstruction, outliers: Array) -> dict[str, list[str]]:
    """Reasons against each photo, whatever moved it."""
    doubts, counts = {name: list[str]() for name in rec.image_names}, _counts(rec)
    for i, said in enumerate(doubts.values()):
        if counts[i] < _FEW:
            said.append(f"only {counts[i]} measurements")
        if outliers[i] > _OUTLIERS:
            said.append(f"{100 * outliers[i]:.0f} % of its measurements contradict the others")
    return doubts


def _doubt_poses(doubts: dict[str, list[str]], misplaced: Mapping[str, str], suspects: Collection[str]) -> None:
    """Add reasons against the poses of photos."""
    for name, said in misplaced.items():
        doubts[name].append(said)
    for name in suspects:
        doubts[name].append(_SUSPECT)


def _texts(doubts: Mapping[str, list[str]]) -> dict[str, str]:
    """Reasons against each photo that has any, as one text."""
    return {name: "; ".join(why) for name, why in doubts.items() if why}


def _times_usual(rec: Reconstruction, phi_rms: float) -> Array:
    """(m,) size of each photo's rotation in standard deviations of all, or of the others of its camera if larger.

    A camera without a shutter makes the standard deviation of all small, and photos taken from a tripod make that of
    their camera small: so of a camera, it is that whose largest component the upper quartile of its photos have.
    """
    size = (np.abs(rec.phi) * rec.frame_span()[:, None]).max(1)
    usual = np.full(rec.num_images, phi_rms)
    for i, camera in enumerate(rec.camera_idx):
        others = np.flatnonzero((rec.camera_idx == camera) & (np.arange(rec.num_images) != i))
        if len(others):
            usual[i] = max(phi_rms, np.quantile(size[others], 0.75) / _UPPER_QUARTILE)
    return size / usual


def _faint(rec: Reconstruction, motions: PhotoMotions) -> dict[str, str]:
    """Photos that may come out worse than they went in, which says nothing about the shape of the whole.

    If an error of two standard deviations is half of what was found, it may be as large as the true motion; in the mean
    over the frame, as a photo is judged.
    """
    found, sigma = motions.shift_px, motions.sigma_px
    faint = ((motions.relative_sigma > 1 / 4) & (sigma > UNSEEN_PX / 2)) | (sigma > _UNCERTAIN_PX)
    return {
        name: f"its motion of {found[i]:.1f} px is only known to +-{sigma[i]:.1f} px"
        for i, name in enumerate(rec.image_names)
        if faint[i]
    }


def _misplaced(result: BundleResult, unexplained: bool) -> dict[str, str]:
    """Reasons against the poses of photos that only the solution determines.

    Against all of them if it leaves measurements `unexplained`: a wrong pose of one bends those of the others.
    """
    names = result.reconstruction.image_names
    if unexplained or not np.isfinite(result.covariances).all():
        return dict.fromkeys(names, "its pose may be wrong: the solution does not explain the measurements")
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(result.covariances[:, :3, :3])[:, -1].clip(0.0)))
    # relative to the fixed photo the others are as uncertain as it is relative to them
    sigma_deg = np.where(sigma_deg > 0, sigma_deg, np.median(sigma_deg[sigma_deg > 0]) if sigma_deg.any() else 0.0)
    said = {
        name: f"its direction is only known to +-{sigma:.1f} degrees"
        for name, sigma in zip(names, sigma_deg, strict=True)
        if sigma > _LOST_DEG
    }
    connected = connected_photos(result.reconstruction)
    few = f"it shows fewer than {LEAST_MEASUREMENTS} points whose place the others determine"
    return said | {name: few for name, held in zip(names, connected, strict=True) if not held}


def _of_photos(rec: Reconstruction, doubts: Mapping[str, list[str]], motions: PhotoMotions) -> list[str]:
    """Reasons in doubtful photos against a whole without other reasons."""
    # a motion that is wrong by this stretches the photo by its share of half the frame, and the scene as much
    half_px = np.array([min(each.width, each.height) / 2 for each in rec.cameras])[rec.camera_idx]
    percent = 100 * float(np.sqrt(np.mean((motions.difference_px / half_px) ** 2)))
    if percent > _SMALL_PERCENT:
        return [
            "Halves of the photos' measurements contradict each other about the motions, by "
            f"{percent:.1f} % of the frame in the mean."
        ]
    doubtful = sum(bool(each) for each in doubts.values())
    return [f"{doubtful} of {rec.num_images} photos are doubtful."] if 2 * doubtful > rec.num_images else []
