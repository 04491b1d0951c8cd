"""What `honest.py` measures: errors over the deviations that are reported, photos against references; and truths."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rsundistort import (
    BundleOptions,
    Camera,
    Reconstruction,
    RectifyOptions,
    RowMotion,
    RunOptions,
    Solution,
    SolvedImage,
    SolveOptions,
    init_rectify_map,
    project_points,
    read_solution,
    rectify,
    unproject_points,
)
from rsundistort.bundle import BundleResult, Posterior
from rsundistort.bundle.intrinsics import DECENTRING, moved_camera
from rsundistort.bundle.triangulate import _world_rays
from rsundistort.critical import Remedy, shape_cost
from rsundistort.critical.common import row_phi
from rsundistort.critical.degeneracy import readout_axes
from rsundistort.evaluation import align_points, motion_errors, psnr
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.io import read_photo, write_image
from rsundistort.io.cameras import camera_from_json
from rsundistort.rectify import steadiest_pinhole
from rsundistort.solve import OutputOptions

Array = np.ndarray


def normalised_errors(
    solution: Solution, truth: Solution, sigmas: Mapping[str, Any] | None = None, log_k: float | None = None
) -> dict[str, Array | None]:
    """Errors over their deviations, of what has both; None of the rest.

    Of phi, rotation and center (m, 3), mean_phi (3,) and log_k ().

    Parameters
    ----------
    solution, truth : Solution
        The truth has motions and poses of all photos that are registered; the centres are aligned by the best
        similarity.
    sigmas : mapping of quantity to array, optional
        Standard deviations, before those that the solution has: of mean_phi in radians per frame, of log_k as
        `log_k_error` says.
    log_k : float, optional
        Its error.
    """
    registered = solution.registered
    span = np.array([[solution.cameras[image.camera_id].frame_span] for image in registered])
    known: dict[str, Any] = {}
    for key, per_frame in (("phi", span), ("rotation", 1.0), ("center", 1.0)):
        own = [getattr(image, f"sigma_{key}") for image in registered]
        known[key] = None if any(each is None for each in own) else per_frame * np.array(own)
    known |= {"log_k": (solution.critical_motion or {}).get("sigma_log_k"), **(sigmas or {})}
    phi = motion_errors(solution, truth).phi_rad_per_frame
    centers, true = (np.array([each.image(image.name).center_w for image in registered]) for each in (solution, truth))
    scale, R, shift = align_points(true, centers)
    R_cw, true_R_cw = (np.array([each.image(image.name).R_cw for image in registered]) for each in (solution, truth))
    # of the world that fits all orientations best
    turn = Rotation.from_matrix(np.einsum("mji,mjk->ik", R_cw, true_R_cw) / len(R_cw)).as_matrix()
    errors = {
        "phi": phi,
        "mean_phi": phi.mean(0),
        "log_k": log_k,
        "rotation": Rotation.from_matrix(R_cw @ turn @ true_R_cw.transpose(0, 2, 1)).as_rotvec(),
        "center": centers - scale * true @ R.T - shift,
    }
    return {
        key: None if error is None or known.get(key) is None else np.asarray(error / known[key])
        for key, error in errors.items()
    }


def pooled(errors: Sequence[Mapping[str, Array | None]], by_component: bool = False) -> dict[str, Any]:
    """Root mean square of the errors of several solutions, by quantity; None where one of them has none."""
    found: dict[str, Any] = {}
    for key in errors[0]:
        values = [np.atleast_2d(value) for each in errors if (value := each[key]) is not None]
        if len(values) < len(errors):
            found[key] = None
            continue
        square = np.mean(np.vstack(values) ** 2, axis=0 if by_component else None)
        found[key] = np.sqrt(square).round(2).tolist()
    return found


def alike(errors: Sequence[Mapping[str, Array | None]]) -> dict[str, float]:
    """Mean correlation of the errors of two solutions, by quantity: 1 if several sets of photos err as one does.

    Sets that were warped from the same photos share what their keypoints and their calibration have wrong. Quantities
    that one of them lacks, or whose photos are not those of the others, are left out.
    """
    found = {}
    for key in ("phi", "rotation", "center"):
        values = [np.ravel(value) for each in errors if (value := each[key]) is not None]
        if len(values) == len(errors) > 1 and len({len(value) for value in values}) == 1:
            apart = np.triu_indices(len(values), 1)
            found[key] = round(float(np.corrcoef(values)[apart].mean()), 2)
    return found


def run_options(**given: Any) -> RunOptions:
    """Options of a run without a report, of the fields of all its parts."""
    parts = {
        part: kind(**{key: given.pop(key) for key in [*given] if key in kind.__dataclass_fields__})
        for part, kind in (("solve", SolveOptions), ("rectify", RectifyOptions))
    }
    return RunOptions(**parts, outputs=OutputOptions(report=False), **given)


def _with_anchors(result: BundleResult, remedy: Remedy | None, options: BundleOptions) -> BundleOptions:
    """The options of the adjustments, with the constraint of the remedy."""
    rec = result.reconstruction
    if remedy is not None and remedy.name == "anchor":
        first = dict(zip(rec.image_names, row_phi(rec)[:, 0], strict=True))
        held = {name: np.where(np.arange(3) == first[name], sigma, np.inf) for name, sigma in remedy.anchors.items()}
        options = replace(options, known_phi={name: (np.zeros(3), sigma) for name, sigma in held.items()})
    return replace(options, bends=len(result.bend_sigmas))


def log_k_sigmas(result: BundleResult, remedy: Remedy | None, options: BundleOptions) -> Array:
    """(2,) standard deviations of log k: by the measurements, and by priors and calibrations."""
    how = _with_anchors(result, remedy, options)
    both, rest = (shape_cost(each, how).sigma_log_k for each in (result, replace(result, inflation=1e-9)))
    return np.sqrt([max(both**2 - rest**2, 0.0), rest**2])


def from_elsewhere(path: Sequence[Mapping[str, Any]], seed: int) -> list[dict[str, Any]]:
    """A recipe's path for another visit to the scene: its photos are taken from other places nearby.

    Each camera is moved by up to two fifths of the way to its neighbours, along each axis. It looks at what it did, and
    as much up or down: cameras that are level stay so.
    """
    centers = np.array([each["center_w"] for each in path], float)
    apart = float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1)))
    moves = np.random.default_rng([seed, 11]).uniform(-0.4 * apart, 0.4 * apart, centers.shape)
    raised = moves * (0, 0, 1)
    return [
        {**each, "center_w": (each["center_w"] + move).tolist(), "look_at_w": (each["look_at_w"] + rise).tolist()}
        for each, move, rise in zip(path, moves, raised, strict=True)
    ]


def apart_and_together(errors: Sequence[float], sigmas: Sequence[Array]) -> dict[str, float]:
    """Of sets (n,) warped from the same photos: what their errors share, and what they do not, by what each should be.

    Their measurements have the same noise, since keypoints, lens and scene are the same: its part of the error is one
    draw in all sets. Priors and calibrations err anew in each. `shared` is their mean error over the deviation by the
    measurements, `own` the scatter over the deviation by the rest.
    """
    of_noise, of_rest = np.sqrt(np.mean(np.square(sigmas), axis=0))
    return {
        "shared": round(float(np.mean(errors) / of_noise), 2),
        "own": round(float(np.std(errors, ddof=1) / of_rest), 2),
    }


def library_sigmas(result: BundleResult, remedy: Remedy | None, options: BundleOptions) -> dict[str, Any]:
    """Deviations that are not in solution.json, as `normalised_errors` takes them, photos in the order of their names.

    `options` are those of the adjustments; of a constraint that was added to them `remedy` knows.
    """
    rec = result.reconstruction
    if rec.shutter_model == "global":
        return {}
    m, nb = result.covariances.shape[:2]
    posterior = Posterior(result, _with_anchors(result, remedy, options))
    mean = np.zeros((3, m, nb))
    mean[:, :, 6:9] = np.eye(3)[:, None] * rec.frame_span()[:, None] / m
    variance = (mean * posterior.of_photos(mean)).sum((1, 2))
    return {"mean_phi": np.sqrt(variance)}


def _meeting_points(rec: Reconstruction) -> tuple[Array, Array]:
    """Where the rays of each point's measurements come nearest to each other (n, 3), and where they do meet (n,)."""
    point_idx = rec.observations.point_idx
    centers, rays, valid = _world_rays(rec, np.arange(len(point_idx)), rec.shutter_model)
    across = valid[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None])
    A, b = np.zeros((rec.num_points, 3, 3)), np.zeros((rec.num_points, 3))
    np.add.at(A, point_idx, across)
    np.add.at(b, point_idx, np.einsum("kij,kj->ki", across, centers))
    meet = np.linalg.eigvalsh(A)[:, 0] > 1e-6
    return np.linalg.solve(A + 1e-12 * np.eye(3), b[..., None])[..., 0], meet


def log_k_error(rec: Reconstruction, truth: Solution) -> float:
    """Logarithm of by how much too high the scene is, along the mean axis of readout against the other two.

    Of the affine map that takes true points to those found; a true point is where the rays of its own measurements meet
    under the true poses and motions. Far points hardly count, as in `critical.shape_cost`.
    """
    images = [truth.image(name) for name in rec.image_names]
    cameras = [truth.cameras[image.camera_id] for image in images]
    true = replace(
        rec, cameras=cameras, camera_idx=np.arange(len(images)), R_cw=np.array([image.R_cw for image in images]),
        center_w=np.array([image.center_w for image in images]), shutter_model=truth.shutter_model,
    ).with_motions([image.motion or RowMotion() for image in images])  # fmt: skip
    points, meet = _meeting_points(true)
    x, y = points[meet], rec.points_w[meet]
    weight = np.ones(len(x))
    for each in (x, y):
        distance = np.linalg.norm(each - np.median(each, axis=0), axis=1)
        weight = np.minimum(weight, (np.median(distance) / np.maximum(distance, 1e-300)) ** 4)
    x, y = (each - np.average(each, axis=0, weights=weight) for each in (x, y))
    B = np.linalg.solve((weight[:, None] * x).T @ x, (weight[:, None] * x).T @ y).T
    axes = readout_axes(true.R_cw, [camera.readout for camera in cameras])
    along = np.linalg.norm(B @ np.linalg.eigh(axes.T @ axes)[1][:, -1])
    return float(1.5 * np.log(along) - 0.5 * np.log(np.abs(np.linalg.det(B))))


def against_references(out: Path, solution: Solution, truth: Solution, references: Path) -> dict[str, float]:
    """Rectified photos against references rotated as the solution's pose has them, for a lens that was solved for.

    A principal point that is off is a pose that is rotated, and no error of the photo: so each reference is seen by the
    solution's camera, rotated by what fits the true directions of its pixels best. `psnr_db` is the median over the
    photos, `left_px` that of the root mean square by which pixels are out of place. The true camera has no lens.
    """
    decibels, left = [], []
    for image in solution.registered:
        camera, true = solution.cameras[image.camera_id], truth.image(image.name)
        taken_by, K = truth.cameras[true.camera_id], solution.rectified_cameras[image.camera_id].K
        assert image.motion is not None
        motion = image.motion if image.R_cw is None else image.motion.in_camera(image.R_cw)
        maps = np.dstack(init_rectify_map(camera, motion, solution.shutter_model, new_K=K))
        some = np.s_[10:-10:20, 10:-10:20]
        xy = np.stack(np.meshgrid(*map(np.arange, maps.shape[1::-1])), axis=2)[some].reshape(-1, 2).astype(float)
        raw = maps[some].reshape(-1, 2).astype(float)
        ideal, valid = unproject_points(raw, taken_by, true.motion, truth.shutter_model)
        rays, true_rays = np.insert(xy, 2, 1, 1) @ np.linalg.inv(K).T, np.insert(ideal, 2, 1, 1)
        unit = [(each / np.linalg.norm(each, axis=1, keepdims=True))[valid] for each in (true_rays, rays)]
        turn = taken_by.K @ Rotation.align_vectors(*unit)[0].as_matrix() @ np.linalg.inv(K)
        apart = cv2.perspectiveTransform(xy[None], turn)[0] - (true_rays @ taken_by.K.T)[:, :2]
        left.append(float(np.sqrt((apart[valid] ** 2).sum(1).mean())))
        mask = read_photo(out / "masks" / f"{Path(image.name).stem}.png").pixels
        pair = read_photo(references / image.name).pixels, np.full(mask.shape, 255, np.uint8)
        how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        reference, seen = (cv2.warpPerspective(each, turn, mask.shape[::-1], flags=how) for each in pair)
        decibels.append(
            psnr(read_photo(out / "images" / image.name).pixels, reference, np.minimum(mask, seen) // 255 * 255)
        )
    return {"psnr_db": round(float(np.median(decibels)), 2), "left_px": round(float(np.median(left)), 3)}


def with_lens_of(out: Path, truth: Path) -> Path:
    """A truth file, written beside another, with the cameras that a run found, so that references lose that lens.

    What photos lose against such references is not the doing of a lens that was calibrated otherwise.
    """
    content, found = (json.loads(path.read_text()) for path in (truth, out / "solution.json"))
    own = {each["name"]: each["camera_id"] for each in found["images"]}
    content |= {key: found[key] for key in ("cameras", "rectified_cameras")}
    content["images"] = [each | {"camera_id": own[each["name"]]} for each in content["images"]]
    path = truth.with_name(f"{truth.stem}-lens-of-{out.name}.json")
    path.write_text(json.dumps(content))
    return path


def for_the_lens_only(out: Path, truth: Solution, photos: Path, references: Path) -> dict[str, float]:
    """PSNR of the photos, by name, that a run would have written had it corrected the lens that it found, and no more.

    Against references without that lens; `truth` has the cameras of the run (`with_lens_of`). The photos are stored
    with a quality of 100, as the run's must be, so that what encoding and interpolation cost is no difference.
    """
    solution, found = read_solution(out / "solution.json"), {}
    for image in solution.registered:
        name = image.name
        taken_by, rectified = truth.cameras[truth.image(name).camera_id], solution.rectified_cameras[image.camera_id]
        (photo, _), (reference, seen) = (
            rectify(read_photo(folder / name).pixels, taken_by, RowMotion(), "global", rectified)
            for folder in (photos, references)
        )
        write_image(out / "lens-only.jpg", photo, quality=100)
        mask = read_photo(out / "masks" / f"{Path(name).stem}.png").pixels
        found[name] = psnr(read_photo(out / "lens-only.jpg").pixels, reference, np.minimum(mask, seen))
    return found


def steadiest_rotated_view(camera: Camera, before: Camera) -> tuple[Array, Array]:
    """K and the rotation of the pinhole camera whose picture moves least when one lens is taken for another.

    Unlike `rectify.steadiest_pinhole` it may look another way than the camera does, which takes back what a principal
    point that is found elsewhere does to perspective.
    """
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
    xy = np.column_stack([x.ravel(), y.ravel()])
    found, old = (unproject_points(xy, each, RowMotion(), "global")[0] for each in (camera, before))
    rays, f, f_before = np.insert(found, 2, 1, 1), np.diag(camera.K)[:2], np.diag(before.K)[:2]

    def apart(unknowns: Array) -> Array:
        """Rotation, relative change of the focal lengths, shift of the principal point in focal lengths."""
        seen = Rotation.from_rotvec(unknowns[:3]).apply(rays)
        ideal = (1.0 + unknowns[3]) * seen[:, :2] / seen[:, 2:] + unknowns[4:]
        residuals: Array = f * ideal - f_before * old
        return residuals.ravel()

    rotvec, zoom, shift = np.split(least_squares(apart, np.zeros(6), x_scale="jac").x, [3, 4])
    K = np.array(before.K)
    K[[0, 1], [0, 1]] = (1.0 + zoom) * f
    K[:2, 2] += shift * f
    return K, Rotation.from_rotvec(rotvec).as_matrix()


def by_true_motions(camera: Camera, truth: Solution, photos: Path, references: Path, rotated: bool) -> float:
    """Median PSNR over the photos that a run would have written had it found this camera and the true motions.

    Against references as they are, in the view that a run has by default, or in the one that is rotated as well.
    """
    decibels = []
    for image in truth.images:
        before = truth.cameras[image.camera_id]
        K, R = steadiest_rotated_view(camera, before) if rotated else (steadiest_pinhole(camera, before).K, np.eye(3))
        x, y = init_rectify_map(camera, image.motion, truth.shutter_model, R, K)
        photo, reference = (read_photo(folder / image.name).pixels for folder in (photos, references))
        mask = ((x >= 0) & (x <= camera.width - 1) & (y >= 0) & (y <= camera.height - 1)).astype(np.uint8) * 255
        decibels.append(psnr(cv2.remap(photo, x, y, cv2.INTER_CUBIC), reference, mask))
    return round(float(np.median(decibels)), 2)


def fountain_truth(folder: Path) -> Solution:
    """The truth of fountain-small."""
    camera = camera_from_json(json.loads((folder / "camera.json").read_text()), "camera.json")
    images = [
        SolvedImage(name, "1", each["R_cw"], each["center_w"], RowMotion(each["phi"], each["velocity"]))
        for name, each in json.loads((folder / "truth.json").read_text()).items()
    ]
    return Solution("constant-motion", {"1": camera}, {"1": camera.pinhole()}, images)


def with_poses(truth: Solution, poses: Solution) -> Solution:
    """The truth of warped photos, with poses of the photos as they were."""
    of = {image.name: image for image in poses.images}
    images = [replace(i, R_cw=of[i.name].R_cw, center_w=of[i.name].center_w) for i in truth.images]
    return replace(truth, images=images)


def with_drawn_errors(cameras: dict[str, Any], seed: int) -> dict[str, Any]:
    """A file of exact cameras, each off by errors drawn from the standard deviations of a calibration."""
    rng, content = np.random.default_rng(seed), json.loads(json.dumps(cameras))
    for each in content.get("cameras", {"": content}).values():
        camera = camera_from_json({**each, "dist": [*each["dist"], *[0.0] * 5][:5]}, "drawn")
        prior = PhotoCameras((camera,), ("",), np.zeros(1, int), True, (True,), "").known_to(loose=False)
        (sigmas,), (decentring,) = prior.sigmas, prior.decentring
        names = ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        off = {name: sigmas[name] * rng.normal() for name in names}
        for error, terms in zip(decentring * rng.normal(size=2), DECENTRING, strict=True):
            off |= {name: off[name] + error * times for name, times in terms.items()}
        given = moved_camera(camera, names, np.array([*off.values()]))
        each |= {"K": given.K.tolist(), "dist": given.dist.tolist()}
    return content


def moved_photo(
    pixels: np.ndarray, depth: np.ndarray, camera: Camera, motion: RowMotion, steps: int = 30
) -> tuple[np.ndarray, np.ndarray]:
    """What a rolling shutter makes of a photo, and where it is known: each pixel is looked for by fixed point."""
    height, width = depth.shape
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=2).reshape(-1, 2).astype(float)
    ideal, _ = unproject_points(xy, camera, None, "global")
    points = np.column_stack([ideal, np.ones(len(ideal))]) * depth.reshape(-1, 1)
    seen, valid = project_points(points, camera, motion, "constant-motion")
    shift = np.where((valid & np.isfinite(depth.ravel()))[:, None], seen - xy, np.nan)
    shift = shift.reshape(height, width, 2).astype(np.float32)
    target = xy.reshape(height, width, 2).astype(np.float32)
    source = target.copy()
    for _ in range(steps):
        found = cv2.remap(shift, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderValue=(np.nan, np.nan))
        source = target - np.nan_to_num(found)
    found = cv2.remap(shift, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderValue=(np.nan, np.nan))
    known = (np.abs(source + found - target) < 0.05).all(axis=2)
    return cv2.remap(pixels, source[..., 0], source[..., 1], cv2.INTER_LANCZOS4), known
