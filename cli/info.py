"""`rsundistort info`."""

from __future__ import annotations

import json
import re
from importlib.metadata import PackageNotFoundError, requires, version

import click

from . import options as opt
from .terminal import errors_for_people, table, tell

# extras for those who work on the project
_OURS = ("dev", "docs")


@click.command()
@opt.json_option
def command(as_json: bool) -> None:
    """Show versions, threads and optional parts."""
    with errors_for_people():
        from rsundistort.batch import use_threads
        from rsundistort.versions import versions

        found: dict[str, object] = {
            "versions": versions(),
            "threads": use_threads(0),
            "extras": _extras(),
        }
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


def _text(found: dict[str, object]) -> str:
    versions, extras = found["versions"], found["extras"]
    assert isinstance(versions, dict)
    assert isinstance(extras, dict)
    rows = [*versions.items(), ("threads", str(found["threads"]))]
    optional = [("optional part", "")]
    for extra, packages in sorted(extras.items()):
        lost = [name for name, number in packages.items() if number is None]
        has = ", ".join(f"{name} {number}" for name, number in packages.items())
        optional.append((extra, f'no: pip install "rsundistort[{extra}]"' if lost else has))
    return f"{table(rows)}\n\n{table(optional)}"
