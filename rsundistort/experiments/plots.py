"""Figures of the experiments; need matplotlib, which is an extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..model.array_types import Array
from ..report.figures import need_matplotlib
from .paths import PathComparison

__all__ = ["camera_paths", "cumulative_histograms", "plan_axes"]

_LABELS = {
    "wo-rs": "w/o RS",
    "rs": "w/ RS",
    "rs-star": "w/ RS*",
    "rs-linearized": "w/ RS(r[φ]×)",
    "rotation": "rotation",
    "constant-motion": "constant-motion",
}
_AXES = {
    "rotation_deg": "rotation error [deg]",
    "translation": "translation error [baselines]",
    "structure": "structure error [baselines]",
}


def cumulative_histograms(entries: Sequence[Mapping[str, Any]], methods: Sequence[str], path: Path) -> None:
    """Share of trials whose error is below a value: a row for each metric, a column for each scene."""
    figure_of = need_matplotlib()
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    scenes = list(dict.fromkeys(entry["scene"] for entry in entries))
    figure = figure_of(figsize=(3.2 * len(scenes) + 0.6, 2.5 * len(_AXES) + 0.6))
    axes = figure.subplots(len(_AXES), len(scenes), squeeze=False)
    for row, (metric, label) in enumerate(_AXES.items()):
        for column, scene in enumerate(scenes):
            ax = axes[row, column]
            for number, method in enumerate(methods):
                values = sorted(e[metric] for e in entries if (e["scene"], e["method"]) == (scene, method))
                share = np.arange(1, len(values) + 1) / len(values)
                ax.step(values, share, where="post", color=f"C{number}", label=_LABELS.get(method, method), lw=1.5)
            # the methods' errors differ by orders of magnitude
            ax.set_xscale("log")
            low, high = ax.get_xlim()
            subs = (1, 2, 5) if high < 60 * low else (1,)  # more labels would lie on each other
            ax.xaxis.set_major_locator(LogLocator(subs=subs))
            ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.set_ylim(0, 1)
            ax.grid(alpha=0.3, which="major")
            ax.set_xlabel(label)
            if column == 0:
                ax.set_ylabel("share of trials")
            if row == 0:
                ax.set_title(scene)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=min(len(methods), 6), frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    figure.savefig(path, dpi=130)


def plan_axes(center_w: Array, R_cw: Array) -> Array:
    """Two unit vectors (2, 3): right and up of a drawing that shows a camera path from where it varies least.

    Seen from above rather than from below (a mirrored path would mislead), rotated so that the cameras look up the
    page rather than down.

    Parameters
    ----------
    center_w, R_cw : (m, 3), (m, 3, 3) array
        Poses, world to camera.
    """
    axes = np.linalg.svd(center_w - center_w.mean(0))[2]
    right, up, towards = axes[0], axes[1], np.cross(axes[0], axes[1])
    # y of the camera points down, z ahead
    if towards @ R_cw[:, 1].sum(0) > 0:
        right = -right
    if up @ R_cw[:, 2].sum(0) < 0:
        right, up = -right, -up
    return np.array([right, up])


def camera_paths(found: PathComparison, shutter_model: str, path: Path) -> None:
    """Plan view of the camera paths of experiment two, and the distances from the path of the still photos."""
    figure = need_matplotlib()(figsize=(11, 4.6), layout="constrained")
    plan, distances = figure.subplots(1, 2, width_ratios=(1.5, 1))
    axes = plan_axes(found.still_w, found.R_cw)
    middle = found.still_w.mean(0)
    # colours and marks of the paper's figure
    still = ("photos taken still", found.still_w, "k", "x")
    without = ("w/o RS", found.centers_w["without"], "tab:red", "s")
    ours = (f"w/ RS ({_LABELS.get(shutter_model, shutter_model)})", found.centers_w["with"], "tab:blue", "o")
    for label, center_w, color, mark in (without, ours, still):
        x, y = axes @ (center_w - middle).T
        hollow = {} if mark == "x" else {"markerfacecolor": "none"}
        plan.plot(x, y, color=color, marker=mark, lw=1, ms=7, label=label, **hollow)
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel("baselines")
    plan.set_ylabel("baselines")
    plan.set_title("camera positions, plan view")
    plan.legend(frameon=False)
    number = np.arange(len(found.names))
    for key, (label, _, color, mark) in (("without", without), ("with", ours)):
        distances.plot(number, found.position[key], color=color, marker=mark, ms=5, lw=1, label=label)
    # the two differ by orders of magnitude
    distances.set_yscale("log")
    shown = number[:: -(-len(number) // 20)]
    distances.set_xticks(shown, [found.names[k] for k in shown], rotation=90)
    distances.set_ylabel("baselines")
    distances.set_title("distance from the still photo's position")
    distances.grid(alpha=0.3, axis="y")
    distances.legend(frameon=False)
    figure.savefig(path, dpi=130)
