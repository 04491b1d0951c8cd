"""How far the paper's two-step model is from the exact rotation: prints JSON lines, draws docs/two-step-error.png.

    python benchmarks/two_step_error.py [--figure FILE] [--axes N] [--table]

Needs matplotlib (`pip install rsundistort[figures]`); half a minute. docs/two-step.md explains the figures.

A camera without lens distortion, 1000 px wide, 3:2, sees a grid of directions that fills its photo. Its shutter runs
top to bottom while it rotates about a random axis. Where it shows the directions is computed with the exact rotation
and with the two-step model, which is given

- `same_phi`: the true phi;
- `fitted`: the phi that brings the two closest, by least squares over the grid: what a solver would find whose poses
  are right;
- `fitted_with_pose`: phi and the orientation of the camera, by least squares: what a solver could find at best.

Figures are pixels per 1000 pixels of image width. For each axis the root mean square and the largest displacement over
the grid are taken; `median` and `worst` are over the axes.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, unproject_points
from rsundistort.model.projection import project_points_with_jacobians

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT = 1000, 667
FOV_DEG = (30, 45, 60, 75, 90, 105, 120)
RAD_PER_FRAME = (0.005, 0.01, 0.02, 0.05, 0.1)
KINDS = ("same_phi", "fitted", "fitted_with_pose")
#: Noise of good features, in the same unit: half a pixel in a photo 1500 wide.
NOISE_PX = 0.33


def make_camera(fov_deg: float) -> Camera:
    f = WIDTH / 2 / np.tan(np.radians(fov_deg) / 2)
    return Camera(WIDTH, HEIGHT, [[f, 0, (WIDTH - 1) / 2], [0, f, (HEIGHT - 1) / 2], [0, 0, 1]])


def two_step_pixels(
    directions: NDArray[np.float64], camera: Camera, unknowns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) under the two-step model, and their derivatives (n, 2, 6) in phi and a rotation of the camera."""
    turned = Rotation.from_rotvec(unknowns[3:]).apply(directions)
    xy, valid, J = project_points_with_jacobians(turned, camera, RowMotion(unknowns[:3]), "two-step")
    if not valid.all():
        raise ValueError("the two-step model does not show every direction")
    # a further small rotation w moves a direction d by w x d
    moved = np.cross(np.eye(3)[None], turned[:, None])  # (n, 3 of w, 3)
    return xy, np.concatenate([J.phi, np.einsum("nij,nwj->niw", J.point, moved)], axis=2)


def fit(
    directions: NDArray[np.float64], camera: Camera, exact: NDArray[np.float64], start: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """What is left (n, 2), in pixels, after Gauss-Newton over the first `count` of phi and orientation."""
    unknowns = np.concatenate([start, np.zeros(3)])
    for _ in range(20):
        xy, J = two_step_pixels(directions, camera, unknowns)
        step = np.linalg.lstsq(J[..., :count].reshape(-1, count), (exact - xy).ravel(), rcond=None)[0]
        unknowns[:3] += step[:3]
        if count == 6:
            unknowns[3:] = (Rotation.from_rotvec(step[3:]) * Rotation.from_rotvec(unknowns[3:])).as_rotvec()
        if np.abs(step).max() < 1e-9:
            break
    else:
        raise ValueError("the fit did not end")
    return two_step_pixels(directions, camera, unknowns)[0] - exact


def errors(fov_deg: float, rad_per_frame: float, axes: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """For each kind of phi an array (axes, 2): root mean square and largest displacement in pixels."""
    camera = make_camera(fov_deg)
    u, v = np.meshgrid(np.linspace(0, WIDTH - 1, 25), np.linspace(0, HEIGHT - 1, 17))
    exact = np.column_stack([u.ravel(), v.ravel()])
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    for axis in axes:
        phi = axis * rad_per_frame / camera.frame_span
        xy, valid = unproject_points(exact, camera, RowMotion(phi))
        if not valid.all():
            raise ValueError("the rotation model does not answer for every pixel")
        directions = np.column_stack([xy, np.ones(len(xy))])
        rests = {
            "same_phi": two_step_pixels(directions, camera, np.concatenate([phi, np.zeros(3)]))[0] - exact,
            "fitted": fit(directions, camera, exact, phi, 3),
            "fitted_with_pose": fit(directions, camera, exact, phi, 6),
        }
        for kind, rest in rests.items():
            length = np.linalg.norm(rest, axis=1)
            found[kind].append((float(np.sqrt(np.mean(length**2))), float(length.max())))
    return {kind: np.array(values) for kind, values in found.items()}


def figures(fov_deg: float, rad_per_frame: float, axes: NDArray[np.float64]) -> dict[str, float]:
    """The figures of one field of view and rotation, flat: `fitted_rms_px_worst` and so on."""
    row = {"fov_deg": fov_deg, "rad_per_frame": rad_per_frame}
    for kind, values in errors(fov_deg, rad_per_frame, axes).items():
        for column, name in enumerate(("rms_px", "largest_px")):
            row[f"{kind}_{name}_median"] = round(float(np.median(values[:, column])), 4)
            row[f"{kind}_{name}_worst"] = round(float(values[:, column].max()), 4)
    return row


def rule(rows: list[dict[str, float]]) -> dict[str, float]:
    """Error over rotation and tan(fov / 2), nearly one number: its mean, and how far single ones are off at most."""
    result = {}
    for name in ("fitted_rms_px_median", "fitted_rms_px_worst", "fitted_largest_px_median", "fitted_largest_px_worst"):
        slope = np.array([r[name] / r["rad_per_frame"] / np.tan(np.radians(r["fov_deg"]) / 2) for r in rows])
        result[name] = round(float(slope.mean()), 1)
        result[f"{name}_spread"] = round(float(np.abs(slope / slope.mean() - 1).max()), 3)
    return result


def table(rows: list[dict[str, float]]) -> str:
    """Markdown: for each field of view and rotation the worst axis after fitting, rms and largest."""
    head = "| field of view | " + " | ".join(f"{w:g} rad" for w in RAD_PER_FRAME) + " |"
    lines = [head, "| --- |" + " --- |" * len(RAD_PER_FRAME)]
    for fov in FOV_DEG:
        cells = [
            f"{r['fitted_rms_px_worst']:.2f} / {r['fitted_largest_px_worst']:.1f}" for r in rows if r["fov_deg"] == fov
        ]
        lines.append(f"| {fov}° | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """Error over field of view, a colour for each rotation: root mean square on the left, largest on the right."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    colours = plt.get_cmap("viridis")(np.linspace(0.85, 0.0, len(RAD_PER_FRAME)))
    figure, panels = plt.subplots(1, 2, figsize=(11, 5.2), sharex=True, layout="constrained")
    for panel, name, title in zip(
        panels,
        ("rms_px", "largest_px"),
        ("Root mean square over the photo", "Largest anywhere in the photo"),
        strict=True,
    ):
        for rad, colour in zip(RAD_PER_FRAME, colours, strict=True):
            chosen = [r for r in rows if r["rad_per_frame"] == rad]
            for kind, style in (("fitted", "-"), ("same_phi", ":")):
                error = [r[f"{kind}_{name}_worst"] for r in chosen]
                panel.plot(FOV_DEG, error, style, color=colour, marker="o" if style == "-" else None, ms=4)
            panel.annotate(
                f"{rad:g} rad",
                (FOV_DEG[-1], chosen[-1][f"fitted_{name}_worst"]),
                xytext=(8, 0),
                textcoords="offset points",
                va="center",
                color=colour,
            )
        panel.axhline(NOISE_PX, color="0.45", lw=1)
        panel.text(
            139, NOISE_PX * 0.93, "half a pixel in a photo of 1500", color="0.35", ha="right", va="top", fontsize=9
        )
        panel.set(title=title, yscale="log", ylim=(0.05, 100), xlim=(28, 140), xticks=FOV_DEG)
        panel.set_xlabel("horizontal field of view (degrees)")
        panel.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
        panel.grid(which="major", color="0.9")
        panel.set_axisbelow(True)
    panels[0].set_ylabel("displacement (pixels per 1000 pixels of image width)")
    panels[0].plot([], [], "-o", color="0.3", ms=4, label="phi fitted, as a solver does")
    panels[0].plot([], [], ":", color="0.3", label="the true phi")
    panels[0].legend(loc="upper left", frameon=False)
    figure.suptitle(
        "What the two-step model leaves of a rotation during the readout, by its angle per frame (worst axis)"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "two-step-error.png")
    parser.add_argument("--axes", type=int, default=100, help="random axes of rotation for each figure")
    parser.add_argument("--table", action="store_true", help="print the table of docs/two-step.md too, on stderr")
    options = parser.parse_args()
    axes = np.random.default_rng(2017).normal(size=(options.axes, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    rows = []
    for fov in FOV_DEG:
        for rad in RAD_PER_FRAME:
            rows.append(figures(fov, rad, axes))
            print(json.dumps({"name": "two_step_error", **rows[-1]}), flush=True)
    for axis, name in zip(np.eye(3), ("x: pitch", "y: yaw", "z: roll"), strict=True):
        print(
            json.dumps({"name": "two_step_error_one_axis", "axis": name, **figures(60, 0.05, axis[None])}), flush=True
        )
    print(json.dumps({"name": "two_step_error_over_rotation_and_tangent", **rule(rows)}), flush=True)
    draw(rows, options.figure)
    if options.table:
        print(table(rows), file=sys.stderr)


if __name__ == "__main__":
    main()
