"""Figures of the experiments; need matplotlib, which is an extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

__all__ = ["cumulative_histograms"]

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


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("figures need matplotlib; pip install 'rsundistort[figures]'") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def cumulative_histograms(entries: Sequence[Mapping[str, Any]], methods: Sequence[str], path: Path) -> None:
    """Share of trials whose error is below a value: a row for each metric, a column for each scene."""
    plt = _pyplot()
    scenes = list(dict.fromkeys(entry["scene"] for entry in entries))
    figure, axes = plt.subplots(
        len(_AXES), len(scenes), figsize=(3.2 * len(scenes) + 0.6, 2.5 * len(_AXES) + 0.6), squeeze=False
    )  # fmt: skip
    for row, (metric, label) in enumerate(_AXES.items()):
        for column, scene in enumerate(scenes):
            ax = axes[row, column]
            for number, method in enumerate(methods):
                values = sorted(e[metric] for e in entries if (e["scene"], e["method"]) == (scene, method))
                share = np.arange(1, len(values) + 1) / len(values)
                ax.step(values, share, where="post", color=f"C{number}", label=_LABELS.get(method, method), lw=1.5)
            # the methods' errors differ by orders of magnitude
            ax.set_xscale("log")
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
    plt.close(figure)
