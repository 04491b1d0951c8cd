"""Figures for papers: PNG and PDF, by matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..critical.degeneracy import readout_axes
from ..errors import FileError, InputError
from ..io.aside import written_aside
from ..io.outputs import only_writer
from ..io.record import Record
from ..model.array_types import Array
from .content import arrows_of, longer, models, view_frame
from .source import Source, read_source
from .verdict import degeneracy_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["need_matplotlib", "write_figures"]

_OURS, _GLOBAL, _GREY = "#0f7f86", "#c46b1d", "#9a9a9a"
# Photos of which the displacement field is drawn: those that the shutter moved most.
_MOST_FIELDS = 6
_STYLE: dict[str, Any] = {
    "font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6, "lines.linewidth": 1.0,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "legend.frameon": False, "figure.constrained_layout.use": True,
    "pdf.fonttype": 42, "savefig.dpi": 300,
}  # fmt: skip


def write_figures(out: Path | str, figures: Path | str) -> list[Path]:
    """Draw what a run found as figures for papers, each as PNG and as PDF.

    `models` (residuals of the shutter models), `displacement` (the displacement fields of the photos that moved most),
    `paths` (where the cameras were, ours and by a global shutter) and `critical-motion` (the axes of readout on the
    sphere); those that the solution has nothing for are left out.

    Parameters
    ----------
    out : path
        As `run` and `solve` leave it.
    figures : path
        Folder, made if missing; figures of the same names are replaced.

    Raises
    ------
    InputError
        When matplotlib (extra `figures`) is not installed, or there is nothing to draw.
    FileError, FormatError
        When there is no solution, or the figures cannot be written.
    """
    figure_of = need_matplotlib()
    import matplotlib as mpl

    source, folder = read_source(Path(out)), Path(figures)
    drawings: dict[str, Callable[[Figure, Source], bool]] = {
        "models": _models,
        "displacement": _displacement,
        "paths": _paths,
        "critical-motion": _sphere,
    }
    record = Record(folder)
    written = []
    with only_writer(folder), mpl.rc_context(_STYLE):
        record.check(f"{name}.{ending}" for name in drawings for ending in ("png", "pdf"))
        for name, draw in drawings.items():
            figure = figure_of(figsize=(3.4, 2.6))
            if draw(figure, source):
                written += _save(figure, folder, name, record)
    if not written:
        raise InputError(f"{out} holds no registered photo: there is nothing to draw")
    return written


def need_matplotlib() -> Any:
    """The class of figures; an error for people where matplotlib is missing."""
    try:
        # not pyplot: it would choose a window system, and a library must not change what its user chose
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError('figures need matplotlib; install it: pip install "rsundistort[figures]"') from error
    return Figure


def _save(figure: Figure, folder: Path, name: str, record: Record) -> list[Path]:
    paths = []
    try:
        for ending, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None, "Producer": None})):
            path = folder / f"{name}.{ending}"
            with record.writing([path.name]), written_aside(path) as aside:
                figure.savefig(aside, format=ending, metadata=metadata)
            paths.append(path)
    except OSError as error:
        raise FileError(f"{folder} cannot be written: {error.strerror or error}") from error
    return paths


def _models(figure: Figure, source: Source) -> bool:
    rows = [row for row in models(source.solution) if row["held_out"] or row["rms"]]
    if not rows:
        return False
    labels = {"error": "held-out error", "held_out": "held-out residual (px)", "rms": "residual (px)"}
    key = next(key for key in labels if any(row[key] for row in rows))
    rows = [row for row in rows if row[key]]
    figure.set_size_inches(3.4, 0.6 + 0.32 * len(rows))
    axes = figure.add_subplot()
    values = [row[key] for row in rows]
    colors = [_OURS if row["chosen"] else _GREY for row in rows]
    bars = axes.barh([row["name"] for row in rows], values, height=0.6, color=colors)
    axes.bar_label(bars, labels=[f"{value:.3f}" for value in values], padding=3)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * max(values))
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(labels[key])
    return True


def _displacement(figure: Figure, source: Source) -> bool:
    solution, stored = source.solution, source.diagnostics
    moved = [image for image in solution.registered if image.rs_shift_px is not None]
    moved = sorted(moved, key=lambda image: -(image.rs_shift_px or 0.0))[:_MOST_FIELDS]
    if not moved:
        return False
    depths = {} if stored is None else dict(zip(stored.names, stored.depth.tolist(), strict=True))
    across = min(3, len(moved))
    down = -(-len(moved) // across)
    figure.set_size_inches(2.3 * across, 1.8 * down)
    fields = [arrows_of(solution, image, depths.get(image.name), image.applied_orientation) for image in moved]
    lengths = [np.linalg.norm(still - raw, axis=1).max(initial=0.0) / size[0] for raw, still, size in fields]
    times = longer(lengths)
    for number, (image, (raw, still, (width, height))) in enumerate(zip(moved, fields, strict=True), 1):
        axes = figure.add_subplot(down, across, number)
        axes.quiver(
            *raw.T, *(still - raw).T, color=_OURS, angles="xy", scale_units="xy", scale=1 / times, width=0.005,
            headwidth=4, headlength=4.5, headaxislength=4, minlength=0.3,
        )  # fmt: skip
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[], aspect="equal")
        axes.spines[:].set_visible(True)
        axes.spines[:].set_color(_GREY)
        # a name is no formula
        axes.set_title(f"{image.name}, {image.rs_shift_px:.1f} px", fontsize=7, parse_math=False)
    if times > 1:
        figure.supxlabel(f"arrows drawn {times} times as long", fontsize=7, color="#666666")
    return True


def _paths(figure: Figure, source: Source) -> bool:
    solution, stored = source.solution, source.diagnostics
    images = [image for image in solution.registered if image.posed]
    if not images:
        return False
    R, centers = np.array([image.R_cw for image in images]), np.array([image.center_w for image in images])
    V = view_frame(R)
    plain = None
    if stored is not None:
        place = {name: i for i, name in enumerate(stored.names)}
        plain = stored.global_center_w[[place[image.name] for image in images]]
    figure.set_size_inches(6.2, 2.8)
    for number, (label, pair) in enumerate((("ahead", (0, 1)), ("up", (0, 2))), 1):
        axes = figure.add_subplot(1, 2, number)
        if stored is not None and len(stored.points_w):
            _mark(axes, (stored.points_w @ V.T)[:, pair])
        if plain is not None:
            axes.plot(*(plain @ V.T)[:, pair].T, "o--", color=_GLOBAL, ms=2.5, label="global shutter")
        axes.plot(*(centers @ V.T)[:, pair].T, "o-", color=_OURS, ms=2.5, label="rolling shutter")
        axes.set(aspect="equal", xlabel="right in the photos (world units)", ylabel=label)
    figure.legend(*axes.get_legend_handles_labels(), fontsize=7, loc="outside upper center", ncols=2)
    return True


def _mark(axes: Any, shown: Array) -> None:
    """The scene's points, faint, behind the paths."""
    low, high = np.quantile(shown, [0.02, 0.98], axis=0)
    shown = shown[((shown >= low) & (shown <= high)).all(1)]
    axes.plot(*shown.T, ".", color="#c9c9c9", ms=0.6, rasterized=True)


def _sphere(figure: Figure, source: Source) -> bool:
    solution, degeneracy = source.solution, degeneracy_of(source.solution)
    images = [image for image in solution.registered if image.posed]
    if not images:
        return False
    R = np.array([image.R_cw for image in images])
    # the mean photo's up as z
    axes_w = readout_axes(R, [solution.cameras[image.camera_id].readout for image in images]) @ view_frame(R).T
    figure.set_size_inches(3.0, 3.0)
    axes = figure.add_subplot(projection="3d")
    angle = np.linspace(0, 2 * np.pi, 73)
    for k in range(-2, 3):
        z, r = np.sin(k * np.pi / 6), np.cos(k * np.pi / 6)
        axes.plot(r * np.cos(angle), r * np.sin(angle), np.full_like(angle, z), color="#dddddd", lw=0.5)
    for k in range(6):
        r, a = np.cos(angle), k * np.pi / 6
        axes.plot(r * np.cos(a), r * np.sin(a), np.sin(angle), color="#dddddd", lw=0.5)
    for axis in axes_w:
        axes.plot(*np.stack([axis, -axis]).T, "o-", color=_OURS, ms=2.5, lw=0.7)
    axes.set_box_aspect((1, 1, 1), zoom=1.45)
    axes.set_axis_off()
    axes.view_init(elev=20, azim=-65)
    if degeneracy is not None:
        figure.suptitle(
            f"degeneracy {degeneracy.value:.3f}, axes {degeneracy.y_axis_spread_deg:.1f}° apart", fontsize=8
        )
    return True
