"""`report.html`: one file that a person opens."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RsUndistortWarning
from ..io.aside import write_aside
from ..io.outputs import only_writer
from ..io.record import Record
from . import content
from .facts import map_facts, map_rows, readout_facts
from .pictures import Picture, PictureJob, make_pictures
from .source import Source, read_source
from .verdict import advice_of, degeneracy_of, verdict_of

if TYPE_CHECKING:
    from jinja2 import Template

__all__ = ["write_report"]

_NAME = "report.html"
# Keys that solutions of earlier versions, or of others, may lack.
_QUALITY = dict.fromkeys(("num_points", "rms_px", "global_rms_px"))
_CRITICAL = dict.fromkeys(("meaning", "sentence", "remedy", "anchors", "warnings"))


def write_report(
    out: Path | str,
    photos: Path | str | None = None,
    *,
    jobs: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Path:
    """Write `report.html` into a folder of outputs: one file that needs no network.

    What is missing (raw photos, `report.npz`) is said in it and in a warning, and the rest is shown.

    Parameters
    ----------
    out : path
        As `run` and `solve` leave it.
    photos : path, optional
        Folder of the raw photos; else where it was when the solution was made, seen from `out`.
    jobs : int
        Threads; 0 for all cores.
    progress : callable, optional
        Called as (stage, done, total).

    Raises
    ------
    FileError, FormatError
        When there is no solution, or it cannot be understood; when a report is there that was not written here.
    """
    source = read_source(Path(out), None if photos is None else Path(photos))
    for note in source.notes:
        warnings.warn(note, RsUndistortWarning, stacklevel=2)
    record = Record(source.out)
    with only_writer(source.out):
        record.check([_NAME])
        pictures = _pictures(source, jobs or os.cpu_count() or 1, progress)
        page = _page(source, pictures).encode(errors="backslashreplace")
        with record.writing([_NAME]):
            write_aside(source.out / _NAME, page)
    return source.out / _NAME


def _pictures(source: Source, threads: int, progress: Callable[[str, int, int], None] | None) -> dict[str, Picture]:
    jobs = {}
    for image in source.solution.registered:
        before, after = source.before(image.name), source.after(image.name)
        if before is not None or after is not None:
            jobs[image.name] = PictureJob(before, after, image.applied_orientation)
    tell = None if progress is None else lambda done: progress("report", done, len(jobs))
    return dict(zip(jobs, make_pictures(list(jobs.values()), threads, tell), strict=True))


def _page(source: Source, pictures: dict[str, Picture]) -> str:
    from plotly.offline import get_plotlyjs

    solution = source.solution
    views = content.view_of(source, pictures)
    data = {
        "views": views,
        "longer": content.longer([view["longest"] for view in views]),
        "scene": content.scene(source, {name: each.orientation for name, each in pictures.items()}),
        "residuals": content.residuals(source),
    }
    here = files(__package__)
    return _template().render(
        name=source.out.resolve().name,
        solution=solution,
        verdict=verdict_of(solution),
        degeneracy=degeneracy_of(solution),
        quality={**_QUALITY, **solution.quality},
        critical={**_CRITICAL, **solution.critical_motion} if solution.critical_motion else {},
        advice=advice_of(solution),
        pose_sigma_deg=content.pose_sigma_deg(solution),
        notes=source.notes,
        photos=content.photos(source),
        motions=content.motions(solution),
        views=views,
        data=data,
        models=content.models(solution),
        cameras=content.cameras(solution),
        readout=readout_facts(solution.quality["readout_time"]) if solution.quality.get("readout_time") else [],
        places=map_facts(solution.georeference),
        place_rows=map_rows(solution.georeference),
        settings=content.settings(solution),
        stages=[{"name": "", "seconds": 0.0, **stage} for stage in solution.stages],
        seconds=sum(float(stage.get("seconds") or 0) for stage in solution.stages),
        json=_json(data),
        css=(here / "page.css").read_text("utf-8"),
        script=(here / "page.js").read_text("utf-8"),
        plotly=get_plotlyjs(),
    )


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"number": _number, "seconds": _seconds, "signs": _signs}
    return environment.from_string((files(__package__) / "page.html").read_text("utf-8"))


def _json(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _number(value: Any, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "–"
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")  # no minus before zero


def _seconds(value: Any) -> str:
    seconds = float(value or 0)
    return f"{seconds:.1f} s" if seconds < 60 else f"{int(seconds // 60)} min {seconds % 60:.0f} s"


def _signs(text: Any) -> str:
    """Text of the terminal with typographic signs."""
    return str(text).replace("+-", "±")
