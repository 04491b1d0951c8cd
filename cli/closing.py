"""The table that closes a run."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from math import floor, isfinite, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .terminal import Said, Talk, list_failed, say_json, table, tell

if TYPE_CHECKING:
    from rsundistort.model import Solution

__all__ = ["close", "closing_table", "fitted", "summary"]


_COLUMNS = 80
# what displaces no tenth of a pixel is no news: of a focal length that varies, that is a hundredth of a percent
_LEAST_PX, _LEAST_FOCAL = 0.1, 1e-4
# where what is said of a label begins, and the label of what goes on there
_LABEL, _GOES_ON = 19, " "


def close(solution: Solution, out: Path, warned: Said, talk: Talk) -> None:
    """Say what was found; exit code 3 if photos with a motion could not be rectified, or an output not be written."""
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
    from rsundistort.input.load import UNCONNECTED
    from rsundistort.report import verdict_of

    rows = [("photo", "measurements", "rms px", "deg/frame", "shift px")]
    for image in solution.images:
        name = image.name if len(image.name) <= 32 else f"...{image.name[-29:]}"
        if image.motion is None:
            rows.append((name, "-", "-", "-", "not registered"))
            continue
        span = solution.cameras[image.camera_id].frame_span
        rotation = float((image.motion.phi**2).sum() ** 0.5) * span * 57.29577951308232
        numbers = f"{image.rms_px:.2f}", f"{rotation:.2f}", f"{image.rs_shift_px:.1f}"
        rows.append((name, str(image.num_observations), *numbers))
    verdict = verdict_of(solution)
    total = sum(stage["seconds"] for stage in solution.stages)
    quality, held_out = solution.quality, _held_out(solution.quality)
    before = f"{quality['global_rms_px']:.2f} px with a global shutter, " if solution.shutter_model != "global" else ""
    facts = [
        ("photos registered", f"{len(solution.registered)} of {len(solution.images)}"),
        ("verdict", verdict.headline),
        ("shutter model", solution.shutter_model),
        *([("held-out error", held_out)] if held_out else []),
        *_known_motions(quality),
        *_source(solution),
        *_lens(solution),
        *_shutter(solution),
        ("rms residual", f"{before}{quality['rms_px']:.2f} px{' now' * bool(before)}"),
        ("outputs", f"{out}  ({total:.0f} s)"),
    ]
    # a text without a label is indented below the line above
    lines = [table(rows), "", *(f"{label:<{_LABEL}}{text}" if label else f"  {text}" for label, text in facts)]
    critical, said = solution.critical_motion or {}, [verdict.sentences[2]]
    if critical.get("flagged") and not all(image.lens_only for image in solution.registered):
        # the same but for its capital
        said += [critical["sentence"]] * (critical["sentence"][1:] not in said[0])
        said += ["At the next shoot:", *critical["advice"]] if critical["advice"] else []
    lines += ["", *(line for text in said for line in textwrap.wrap(text, _COLUMNS))]
    doubtful = [image for image in solution.registered if image.doubtful]
    if doubtful:
        # most of the photos cannot be left out
        few = 2 * len(doubtful) <= len(solution.registered)
        lines += ["", f"doubtful (check these{', or leave them out' * few}):"]
        lines += [f"  {image.name}: {image.doubtful}" for image in doubtful]
    lens_only = [image.name for image in solution.registered if image.lens_only]
    if lens_only:
        lines += ["", "lens only (the motion found is not supported by the measurements, and was not removed):"]
        lines += ["  all photos" if len(lens_only) == len(solution.registered) else f"  {', '.join(lens_only)}"]
    lost = [image for image in solution.images if not image.registered]
    if lost:
        lines += ["", "not registered:", *(f"  {image.name}: {image.reason}" for image in lost)]
        tried = any(stage["name"] == "affine features" for stage in solution.stages)
        missing = any(image.reason == UNCONNECTED for image in lost)
        if missing and solution.options.get("features") == "auto" and not tried:
            lines += ["  features that take longer may register more: --features affine"]
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


def _source(solution: Solution) -> Iterator[tuple[str, str]]:
    """Where the cameras come from, with their readout and what was guessed; the model that was given, and the video."""
    options = solution.options
    source, readout = options["camera"], options["readout"]
    if isinstance(readout, str):
        yield "camera", f"{source}, readout {readout}"
    else:
        yield "cameras", source
        yield from (("", f"{group}: readout {each}") for group, each in readout.items())
    yield from (("", line) for text in options.get("guesses", ()) for line in textwrap.wrap(text, 78))
    if model := options.get("model"):
        yield (
            "measurements",
            f"{solution.quality['num_observations']} of {solution.quality['num_points']} points now, "
            f"{model['observations']} of {model['points']} in the model",
        )
        frames = {
            "stored": "not rotated by the EXIF orientation, by the sizes",
            "not looked at": "taken for that of the files",
        }
        yield "pixel frame", frames.get(model["frame"], model["frame"] + ", and rotated back")
    if video := options.get("video"):
        rotated = {3: 180, 6: 90, 8: 270}.get(video["orientation"])
        said = f", players rotate them by {rotated} degrees clockwise, the files do not" if rotated else ""
        what = "key frames of" if "key_frames" in video else "of"
        yield "video", f"{len(solution.images)} {what} {video['frames']} frames{said}"


def _with_sigma(name: str, value: float, sigma: float | None) -> str:
    """An intrinsic and its standard deviation, with as many decimals as show the first digit of that."""
    decimals = 4 if name[0] in "kp" else 1
    if sigma is None or not isfinite(sigma):
        return f"{name} {value:.{decimals}f}"
    if sigma > 0:
        decimals = min(max(decimals, -floor(log10(sigma))), 9)
    return f"{name} {value:.{decimals}f} +- {sigma:.{decimals}f}"


def _lens(solution: Solution) -> Iterator[tuple[str, str]]:
    """Intrinsics that were solved for, with standard deviations; how the lens varies, and what lens models leave."""
    quality = solution.quality
    for keys, camera in solution.shared_cameras.items():
        sigmas = quality["sigma_intrinsics"].get(keys[0], {})
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        values = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **camera.coefficients}
        found = [_with_sigma(name, values[name], sigma) for name, sigma in sigmas.items()]
        told = [", ".join(found[i : i + 3]) for i in range(0, len(found), 3)]
        mine = [image.name for image in solution.registered if image.camera_id in keys]
        if told and mine and len(solution.shared_cameras) > 1:
            others = {0: "", 1: " and 1 other"}.get(len(mine) - 1, f" and {len(mine) - 1} others")
            told = [f"of {mine[0]}{others}:", *told]
        yield from (("refined" if not i else _GOES_ON, each) for i, each in enumerate(told))
    if solution.lens_varied:
        focal, centre = quality["focal_sigma"], quality["centre_sigma_focal_lengths"]
        if centre:
            centre_px = centre * next(iter(solution.cameras.values())).K[0, 0]
            if focal >= _LEAST_FOCAL or centre_px >= _LEAST_PX:
                said = f"f by {100 * focal:.2g} %, principal point by {centre_px:.1f} px from photo to photo"
                yield "varying lens", f"{said} (focusing, a stabiliser)"
        elif focal >= _LEAST_FOCAL:
            yield "varying lens", f"f by {100 * focal:.2g} % from frame to frame (focusing, zooming)"
    if fields := quality.get("lens_fields"):
        largest = max(fields.values(), key=lambda each: each["rms_px"])
        if largest["largest_px"] >= _LEAST_PX:
            said = f"{largest['rms_px']:.2f} px in the mean, {largest['largest_px']:.2f} at most"
            yield "more than a lens", f"{said}, beside the lens model (+-{largest['sigma_px']:.2f})"


def _shutter(solution: Solution) -> Iterator[tuple[str, str]]:
    """The readout time of a video; the place on the map; how fast the camera rotated, depths, and what poses leave."""
    from rsundistort.report import map_facts, readout_facts

    quality = solution.quality
    if evidence := quality.get("readout_time"):
        stabilised = evidence["stabilisation"]["verdict"] == "stabilised"
        shown = ("readout time", "gyroscope", *(("stabilisation",) if stabilised else ()))
        yield from (fact for fact in readout_facts(evidence) if fact[0] in shown)
    yield from map_facts(solution.georeference)
    times = quality.get("readout_times") or {}
    rates = sorted(
        float((image.motion.phi**2).sum() ** 0.5)
        * solution.cameras[image.camera_id].frame_span
        / times[image.camera_id]["ms"]
        * 57295.77951308232
        for image in solution.registered
        if image.motion is not None and image.camera_id in times
    )
    if rates:
        middle = rates[len(rates) // 2]
        yield "rotation rates", f"median {middle:.1f}, largest {rates[-1]:.1f} deg/s, by a readout of"
        said = dict.fromkeys(f"{time['ms']:g} ms ({time['source']})" for time in times.values())
        yield from ((_GOES_ON, each) for each in said)
    used = [image.depth for image in solution.images if image.depth is not None]
    kinds = {"points": "as the points", "plane": "on a plane", "map": "by maps", "infinity": "at infinity"}
    if counts := [f"{text} in {used.count(kind)} photos" for kind, text in kinds.items() if kind in used]:
        yield "depth", ", ".join(counts)
    if (left := quality.get("rs_poses_px")) is not None:
        yield "rs-poses", f"motions are not steady: two poses per photo are off by up to {left:.1f} px"


def _known_motions(quality: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What the photos say of motions that are known from elsewhere."""
    if (gain := quality.get("known_motions_gain")) is not None:
        than = "better" if gain > 0 else "worse"
        yield "known motions", f"predict the photos {than} than none, by {abs(gain):.1f} standard errors"
        if quality.get("known_motions_left_out"):
            yield _GOES_ON, "left out, since the photos contradict them"


def _held_out(quality: Mapping[str, Any]) -> str:
    """How well each model of the sequence predicts measurements that it was not fitted to."""
    said, unit = [], " standard errors"
    for model, error in quality["held_out_error"].items():
        gain = quality["held_out_gain"].get(model)
        if gain is None:
            said.append(f"{model} {error:.3f}")
            continue
        kept = "" if model in quality["held_out_kept"] else ": not kept"
        if quality.get("shared_travel") and model == quality["held_out_chosen"]:
            kept = ": kept, since the photos share a travel"
        said.append(f"{model} {error:.3f} ({'better' if gain > 0 else 'worse'} by {abs(gain):.1f}{unit}{kept})")
        unit = ""
    return ", ".join(said)
