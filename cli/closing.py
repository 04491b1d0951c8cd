"""The table that closes a run."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .terminal import Said, Talk, list_failed, say_json, table, tell

if TYPE_CHECKING:
    from rsundistort.model import Solution

__all__ = ["close", "closing_table", "fitted", "summary"]


_COLUMNS = 80
# where what is said of a label begins
_LABEL = 19


def close(solution: Solution, out: Path, warned: Said, talk: Talk) -> None:
    """Say what was found; exit code 3 if photos with a motion could not be rectified, or the report not be written."""
    if talk.as_json:
        say_json(summary(solution, out, warned))
    elif talk.to_people:
        tell(closing_table(solution, out))
    failed = {image.name: image.reason for image in solution.registered if image.reason}
    list_failed(failed | warned.missing, talk)


def summary(solution: Solution, out: Path, warned: Sequence[str]) -> dict[str, Any]:
    """Summary of the result for other programs; all of it is in solution.json."""
    shifts = sorted(image.rs_shift_px or 0.0 for image in solution.registered)
    critical = solution.critical_motion
    return {
        "out": str(out),
        "photos": len(solution.images),
        "registered": len(solution.registered),
        "shutter_model": solution.shutter_model,
        "rms_px": solution.quality["rms_px"],
        "global_rms_px": solution.quality["global_rms_px"],
        "shift_px": {"median": shifts[len(shifts) // 2], "largest": shifts[-1]} if shifts else None,
        "critical_motion": None
        if critical is None
        else {key: critical[key] for key in ("flagged", "sigma_log_k", "remedy", "sentence")},
        "readout_time": solution.quality.get("readout_time"),
        "verdict": solution.verdict,
        "georeference": solution.georeference,
        "doubtful": {image.name: image.doubtful for image in solution.registered if image.doubtful},
        "lens_only": [image.name for image in solution.registered if image.lens_only],
        "not_joined": {image.name: image.reason for image in solution.images if not image.registered},
        "failed": {image.name: image.reason for image in solution.registered if image.reason},
        "warnings": list(warned),
        "seconds": round(sum(stage["seconds"] for stage in solution.stages), 3),
    }


def closing_table(solution: Solution, out: Path) -> str:
    """Table of the result with one line per photo, in 80 columns."""
    from rsundistort.report import verdict_of

    rows = [("photo", "measurements", "rms px", "deg/frame", "shift px")]
    for image in solution.images:
        name = image.name if len(image.name) <= 32 else f"...{image.name[-29:]}"
        if image.motion is None:
            rows.append((name, "-", "-", "-", "not registered"))
            continue
        span = solution.cameras[image.camera_id].frame_span
        rotation = float((image.motion.phi**2).sum() ** 0.5) * span * 57.29577951308232
        rows.append(
            (
                name,
                str(image.num_observations),
                f"{image.rms_px:.2f}",
                f"{rotation:.2f}",
                f"{image.rs_shift_px:.1f}",
            )
        )
    quality, verdict = solution.quality, verdict_of(solution)
    total = sum(stage["seconds"] for stage in solution.stages)
    lines = [
        table(rows),
        "",
        f"photos registered  {len(solution.registered)} of {len(solution.images)}",
        f"verdict            {verdict.headline}",
        f"shutter model      {solution.shutter_model}",
        *_held_out(quality),
        *_cameras(solution),
        *_model(solution),
        *_video(solution),
        *_intrinsics(solution),
        *_varying(solution),
        *_fields(solution),
        *_readout_time(solution),
        *_map(solution),
        *_readout(solution),
        *_depths(solution),
        *_two_poses(solution),
        _residual(solution),
        f"outputs            {out}  ({total:.0f} s)",
    ]
    critical, said = solution.critical_motion or {}, [verdict.sentences[2]]
    if critical.get("flagged"):
        # the same but for its capital
        said += [critical["sentence"]] * (critical["sentence"][1:] not in said[0])
        said += ["at the next shoot:", *critical["advice"]] if critical["advice"] else []
    lines += ["", *(line for text in said for line in textwrap.wrap(text, _COLUMNS))]
    doubtful = [image for image in solution.registered if image.doubtful]
    if doubtful:
        lines += ["", "doubtful (check these, or leave them out):"]
        lines += [f"  {image.name}: {image.doubtful}" for image in doubtful]
    lens_only = [image.name for image in solution.registered if image.lens_only]
    if lens_only:
        lines += ["", "lens only (the motion found is not supported by the measurements, and was not removed):"]
        lines += ["  all photos" if len(lens_only) == len(solution.registered) else f"  {', '.join(lens_only)}"]
    lost = [image for image in solution.images if not image.registered]
    if lost:
        lines += ["", "not registered:", *(f"  {image.name}: {image.reason}" for image in lost)]
    return "\n".join(part for line in lines for part in fitted(line))


def fitted(text: str) -> list[str]:
    """Lines of 80 columns; what belongs to a label is indented as its first line is."""
    lines = []
    for line in text.splitlines() or [""]:
        indent = _LABEL if line[:_LABEL].endswith("  ") or not line[:_LABEL].strip() else 4
        lines += (
            [line]
            if len(line) <= _COLUMNS
            else textwrap.wrap(
                line, _COLUMNS, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False
            )
        )
    return lines


def _map(solution: Solution) -> list[str]:
    """Where on the map the solution is, and how well GPS and control points agree with it."""
    from rsundistort.report import map_facts

    facts = map_facts(solution.georeference)
    return [f"{label:<{_LABEL}}{text}" if label else f"  {text}" for label, text in facts]


def _cameras(solution: Solution) -> list[str]:
    """Where the cameras come from, which way they are read out by group where they differ, and what was guessed."""
    source, readout = solution.options["camera"], solution.options["readout"]
    if isinstance(readout, str):
        lines = [f"camera             {source}, readout {readout}"]
    else:
        lines = [f"cameras            {source}", *(f"  {group}: readout {each}" for group, each in readout.items())]
    guesses = solution.options.get("guesses", ())
    return lines + [f"  {line}" for text in guesses for line in textwrap.wrap(text, 78)]


def _model(solution: Solution) -> list[str]:
    """Lines on the model that the measurements come from: how many they were, and in which frame."""
    model = solution.options.get("model")
    if not model:
        return []
    frames = {"stored": "the model shows the photos as they are stored", "not looked at": "taken for the stored one"}
    return [
        f"measurements       {solution.quality['num_observations']} of {solution.quality['num_points']} points now, "
        f"{model['observations']} of {model['points']} in the model",
        f"pixel frame        {frames.get(model['frame'], model['frame'] + ', and rotated back')}",
    ]


def _residual(solution: Solution) -> str:
    """The line on residuals, beside those of a global shutter if there is another."""
    quality = solution.quality
    before = f"{quality['global_rms_px']:.2f} px with a global shutter, " if solution.shutter_model != "global" else ""
    return f"rms residual       {before}{quality['rms_px']:.2f} px{' now' * bool(before)}"


def _intrinsics(solution: Solution) -> list[str]:
    """A line on each camera whose intrinsics were solved for, with standard deviations."""
    lines = []
    for keys, camera in solution.shared_cameras.items():
        sigmas = solution.quality["sigma_intrinsics"].get(keys[0], {})
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        values = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **camera.coefficients}
        found = [
            f"{name} {values[name]:.{4 if name[0] in 'kp' else 1}f}"
            + (f" +- {sigma:.{4 if name[0] in 'kp' else 1}f}" if sigma is not None and isfinite(sigma) else "")
            for name, sigma in sigmas.items()
        ]
        lines += [f"{'refined' if i == 0 else '':19}{', '.join(found[i : i + 3])}" for i in range(0, len(found), 3)]
    return lines


def _varying(solution: Solution) -> list[str]:
    """A line on how the lens differs from photo to photo, if it does."""
    if not solution.lens_varied:
        return []
    focal, centre = solution.quality["focal_sigma"], solution.quality["centre_sigma_focal_lengths"]
    if not centre:  # of a video, by a hundredth of a percent at least: a tenth of a pixel
        line = f"varying lens       f by {100 * focal:.2g} % from frame to frame (focusing, zooming)"
        return [line] if focal >= 1e-4 else []
    camera = next(iter(solution.cameras.values()))
    return [
        f"varying lens       f by {100 * focal:.2g} %, principal point by {centre * camera.K[0, 0]:.1f} px from photo "
        "to photo (focusing, a stabiliser)"
    ]


def _fields(solution: Solution) -> list[str]:
    """A line on what lens models leave, if that was taken out, too."""
    fields = (solution.quality.get("lens_fields") or {}).values()
    if not fields:
        return []
    largest = max(fields, key=lambda each: each["rms_px"])
    return [
        f"more than a lens   {largest['rms_px']:.2f} px in the mean, {largest['largest_px']:.2f} at most, beside the "
        f"lens model (+-{largest['sigma_px']:.2f})"
    ]


def _video(solution: Solution) -> list[str]:
    """A line on the video whose frames the photos are."""
    video = solution.options.get("video")
    if not video:
        return []
    rotated = {3: 180, 6: 90, 8: 270}.get(video["orientation"])
    said = f", players rotate them by {rotated} degrees clockwise, the files do not" if rotated else ""
    what = "key frames of" if "key_frames" in video else "of"
    return [f"video              {len(solution.images)} {what} {video['frames']} frames{said}"]


def _readout_time(solution: Solution) -> list[str]:
    """Lines on the readout time that was measured from a video, and on the evidence."""
    from rsundistort.report.readout_facts import readout_facts

    facts = solution.quality.get("readout_time")
    if not facts:
        return []
    shown = ["readout time", "gyroscope"]
    if facts["stabilisation"]["verdict"] == "stabilised":
        shown.append("stabilisation")
    return [f"{label:<{_LABEL}}{text}" for label, text in readout_facts(facts) if label in shown]


def _readout(solution: Solution) -> list[str]:
    """Lines on how fast the camera rotated, where the time of the readout is known."""
    times = solution.quality.get("readout_times") or {}
    rates = sorted(
        float((image.motion.phi**2).sum() ** 0.5)
        * solution.cameras[image.camera_id].frame_span
        / times[image.camera_id]["ms"]
        * 57295.77951308232
        for image in solution.registered
        if image.motion is not None and image.camera_id in times
    )
    if not rates:
        return []
    said = dict.fromkeys(f"{time['ms']:g} ms ({time['source']})" for time in times.values())
    return [
        f"rotation rates     median {rates[len(rates) // 2]:.1f}, largest {rates[-1]:.1f} deg/s, by a readout of",
        *(f"{'':19}{each}" for each in said),
    ]


def _depths(solution: Solution) -> list[str]:
    """A line on how far away the photos of a camera that travelled were taken to show things."""
    used = [image.depth for image in solution.images if image.depth is not None]
    kinds = {"points": "as the points", "plane": "on a plane", "map": "by maps", "infinity": "at infinity"}
    counts = [f"{text} in {used.count(kind)} photos" for kind, text in kinds.items() if kind in used]
    return [f"depth              {', '.join(counts)}"] if counts else []


def _two_poses(solution: Solution) -> list[str]:
    """A line on what formats with two poses per photo cannot express of motions that are not steady."""
    left = solution.quality.get("rs_poses_px")
    if left is None:
        return []
    return [f"rs-poses           motions are not steady: two poses per photo are off by up to {left:.1f} px"]


def _held_out(quality: Mapping[str, Any]) -> list[str]:
    """A line on how well each model of the sequence predicts measurements that it was not fitted to."""
    said, unit = [], " standard errors"
    for model, error in quality["held_out_error"].items():
        gain = quality["held_out_gain"].get(model)
        if gain is None:
            said.append(f"{model} {error:.3f}")
            continue
        kept = "" if model in quality["held_out_kept"] else ": not kept"
        said.append(f"{model} {error:.3f} ({'better' if gain > 0 else 'worse'} by {abs(gain):.1f}{unit}{kept})")
        unit = ""
    return [f"held-out error     {', '.join(said)}"] if said else []
