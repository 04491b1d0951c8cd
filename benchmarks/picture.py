"""Draw the picture of the README: a photo before and after, and the scene that came with it.

    python benchmarks/picture.py [--photo NAME] [--figure FILE]

Runs `rsundistort run` on sample_scenes/courtyard, and beside the photo and its rectified reference shows points and
cameras, those of a global-shutter reconstruction of the same photos in grey. Needs matplotlib.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pycolmap
from mpl_toolkits.mplot3d.art3d import Line3DCollection

import rsundistort as rs
from rsundistort.evaluation import align_points

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "sample_scenes" / "courtyard"
RUST, GREY = "#b3391f", "#8a8a8a"


def frustum(R_cw: np.ndarray, center_w: np.ndarray, size: float) -> np.ndarray:
    """Lines (8, 2, 3) of a camera: from its centre to the corners of its photo, and between these."""
    corners = size * np.array([[-0.6, -0.4, 1], [0.6, -0.4, 1], [0.6, 0.4, 1], [-0.6, 0.4, 1]])
    corners = corners @ R_cw + center_w
    centre = np.broadcast_to(center_w, corners.shape)
    return np.concatenate([np.stack([centre, corners], 1), np.stack([corners, np.roll(corners, -1, 0)], 1)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photo", default="0003.jpg")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "courtyard.jpg")
    args = parser.parse_args()
    truth = rs.read_solution(SCENE / "ground_truth.json")
    with tempfile.TemporaryDirectory() as work:
        found = rs.run(SCENE / "photos", Path(work) / "out")
        plain = rs.run(
            SCENE / "photos", Path(work) / "plain", rs.RunOptions(solve=rs.SolveOptions(shutter_model="global"))
        )
        after = cv2.imread(str(Path(work) / "out" / "images" / args.photo))
        model = pycolmap.Reconstruction(Path(work) / "out" / "sparse")
    before = cv2.imread(str(SCENE / "photos" / args.photo))
    points = np.array([point.xyz for point in model.points3D.values()])
    colours = np.array([point.color for point in model.points3D.values()]) / 255

    def in_world(solution: rs.Solution) -> tuple[float, np.ndarray, np.ndarray]:
        """The similarity to the true world, whose z is up and whose unit is the metre."""
        names = [image.name for image in solution.registered]
        true = np.array([image.center_w for image in truth.images if image.name in names])
        return align_points(np.array([image.center_w for image in solution.registered]), true)

    figure = plt.figure(figsize=(13.2, 3.1), dpi=110)
    for k, (picture, title) in enumerate(((before, "rolling shutter"), (after, "rectified"))):
        axes = figure.add_axes((0.334 * k, 0, 0.329, 0.92))
        axes.imshow(picture[..., ::-1])
        axes.set_axis_off()
        axes.set_title(title, fontsize=11, pad=4)
    axes = figure.add_axes((0.63, -0.6, 0.41, 2.1), projection="3d")
    axes.patch.set_visible(False)
    scale, A, shift = in_world(found)
    world = scale * points @ A.T + shift
    near = (np.abs(world[:, 0]) < 10) & (world[:, 1] < 16) & (world[:, 2] < 8)  # the house and what is before it
    axes.scatter(*world[near].T, c=colours[near], s=2.5, linewidths=0, depthshade=False)
    for solution, colour in ((plain, GREY), (found, RUST)):
        scale, A, shift = in_world(solution)
        for image in solution.registered:
            lines = frustum(image.R_cw @ A.T, scale * A @ image.center_w + shift, 1.2)
            axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=0.9))
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.view_init(elev=33, azim=-105)
    figure.text(0.83, 0.945, "cameras and points (grey: global shutter)", fontsize=11, ha="center")
    figure.savefig(args.figure, pil_kwargs={"quality": 88})
    print(f"{args.figure}: {args.photo}, {len(found.registered)} cameras, {len(points)} points")


if __name__ == "__main__":
    main()
