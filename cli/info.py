"""`rsundistort info`."""

from __future__ import annotations

import json
import re
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import errors_for_people, table, tell

# extras for those who work on the project
_OURS = ("dev", "docs")


@click.command()
@click.argument("cameras", required=False, type=click.Path(path_type=Path), metavar="[CAMERAS.XML]")
@opt.json_option
def command(cameras: Path | None, as_json: bool) -> None:
    """Show versions, threads and optional parts; or what a cameras.xml of Metashape holds.

    Its rolling_shutter is shown as it is: a rotation and a translation of each photo, in the coordinates of the file.
    """
    with errors_for_people():
        if cameras is not None:
            held = _held(cameras)
            tell(json.dumps(held) if as_json else _text_of_held(held))
            return
        from rsundistort.batch import use_threads
        from rsundistort.versions import versions

        found = {"versions": versions(), "threads": use_threads(0), "extras": _extras()}
    tell(json.dumps(found) if as_json else _text(found))


def _extras() -> dict[str, dict[str, str | None]]:
    """Packages of each optional part, with their versions; None of those that are not installed."""
    extras: dict[str, dict[str, str | None]] = {}
    for requirement in requires("rsundistort") or ():
        match = re.fullmatch(r"""([\w.-]+).*;.*extra == ["']([\w-]+)["']""", requirement)
        if match and match[2] not in _OURS:
            extras.setdefault(match[2], {})[match[1]] = _version(match[1])
    return extras


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _text(found: dict[str, Any]) -> str:
    rows = [*found["versions"].items(), ("threads", str(found["threads"]))]
    optional = [("optional part", "")]
    for extra, packages in sorted(found["extras"].items()):
        lost = [name for name, number in packages.items() if number is None]
        has = ", ".join(f"{name} {number}" for name, number in packages.items())
        optional.append((extra, f'no: pip install "rsundistort[{extra}]"' if lost else has))
    return f"{table(rows)}\n\n{table(optional)}"


def _held(path: Path) -> dict[str, Any]:
    """Cameras, photos and rolling-shutter terms of a `cameras.xml`."""
    from rsundistort.errors import InputError
    from rsundistort.io.metashape import read_metashape

    if path.suffix.lower() != ".xml":
        raise InputError(f"{path} is no cameras.xml of Metashape; run says what is known of photos")
    posed = read_metashape(path)
    cameras = zip(posed.camera_ids, posed.cameras, posed.sensors, strict=True)
    return {
        "photos": len(posed.labels),
        "without_pose": list(posed.unposed),
        "cameras": {
            str(key): {"width": c.width, "height": c.height, "type": sensor.kind, **sensor.parameters, **sensor.shutter}
            for key, c, sensor in cameras
        },
        "rolling_shutter": {
            posed.labels[key]: {
                "rotation": terms.rotation.tolist(),
                "translation": terms.translation.tolist(),
                "angle_deg": terms.angle_deg,
            }
            for key, terms in posed.shutter.items()
        },
    }


def _text_of_held(held: dict[str, Any]) -> str:
    rows = [("photos with a pose", str(held["photos"])), ("photos without", str(len(held["without_pose"])))]
    for key, camera in held["cameras"].items():
        size = f"{camera['width']}x{camera['height']} px"
        rows.append((f"camera {key}", f"{size}, {camera['type']}, f {camera['f']:.2f} px"))
    terms = held["rolling_shutter"]
    rows.append(("photos with rolling_shutter", str(len(terms))))
    if not terms:
        return table(rows)
    photos = [("rolling_shutter", "translation", "rotation")]
    for label, each in terms.items():
        photos.append((label, " ".join(f"{x:.6g}" for x in each["translation"]), f"{each['angle_deg']:.4f} deg"))
    why = "Not used as motion: Agisoft does not publish what it counts from, nor its sign. solve estimates the motions."
    return f"{table(rows)}\n\n{table(photos)}\n\n{why}"
