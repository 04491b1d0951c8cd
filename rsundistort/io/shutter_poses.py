"""Poses of the original photos with their shutter, for renderers that model it: gsplat, instant-ngp, 3dgs-deblur."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..model import Camera, RowMotion, Solution, SolvedImage
from ..model.array_types import Array
from ..model.projection import clock_of
from .nerfstudio import camera_to_world, write_frames

__all__ = ["end_poses", "write_shutter_poses"]

#: instant-ngp's time of a pixel: A + B u + C v + D (blur), with u and v from 0 to 1 between the borders of the photo.
_NGP_SHUTTER = {
    "top-to-bottom": (0.0, 0.0, 1.0, 0.0),
    "bottom-to-top": (1.0, 0.0, -1.0, 0.0),
    "left-to-right": (0.0, 1.0, 0.0, 0.0),
    "right-to-left": (1.0, -1.0, 0.0, 0.0),
}

#: Lines whose poses are written of motions that are not steady, evenly spaced over those of a photo.
_LINES = 65

Pose = tuple[Array, Array]


def write_shutter_poses(folder: Path, solution: Solution, photos: Mapping[str, str], points: str) -> str:
    """Write `gsplat.npz` and `transforms.json` (instant-ngp and 3dgs-deblur) of the photos as they were taken.

    The models that rotate by an approximation (two-step, linearized) are written as the rotation of the same phi. Two
    poses a photo, or one rate, are those of the steady motion that is nearest: `rectify.bend_px` says what that leaves.

    Parameters
    ----------
    solution : Solution
        In the stored frame: poses, motions, raw cameras, and in `quality["readout_times"]` what is known of these.
    photos : mapping of name to path
        Original photos, relative to `folder`; those without are left out.
    points : str
        PLY file of points in the frame of the poses, relative too.

    Returns
    -------
    str
        Why there is no `transforms.json`, for people; empty where there is one.
    """
    images = [image for image in solution.registered if image.posed and image.name in photos]
    cameras = [solution.cameras[image.camera_id] for image in images]
    folder.mkdir(parents=True, exist_ok=True)
    _write_gsplat(folder / "gsplat.npz", solution, images, cameras)
    readout = _readout_time(solution, images)
    frames = []
    for image, camera in zip(images, cameras, strict=True):
        frame = {
            "file_path": photos[image.name],
            "transform_matrix": camera_to_world(*_pose(solution, image, 0.0)),
            "transform_matrix_start": camera_to_world(*_pose(solution, image, -0.5)),
            "transform_matrix_end": camera_to_world(*_pose(solution, image, 0.5)),
            "rolling_shutter": _NGP_SHUTTER[camera.readout],
        }
        if readout is not None:
            frame |= _velocities(solution, image, camera, readout[0])
        frames.append(frame)
    common = {}
    if readout is not None:
        common = {"exposure_time": 0.0, "rolling_shutter_time": readout[0], "time_unit": readout[1]}
    try:
        write_frames(folder / "transforms.json", frames, cameras, points, common)
    except InputError as error:
        return str(error)
    return ""


def _motion(solution: Solution, image: SolvedImage) -> RowMotion:
    """The motion that the solution's model heeds, as far as the measurements support it."""
    motion = image.taken_out
    assert motion is not None
    if solution.shutter_model == "global":
        return RowMotion()
    if solution.shutter_model == "constant-motion":
        return motion
    bent = motion.bend is not None and solution.shutter_model == "rotation"
    # it heeds no positions
    bend = motion.bend.rotated(np.eye(3), np.zeros((3, 3))) if bent and motion.bend else None
    return RowMotion(motion.phi, bend=bend)


def _steady(solution: Solution, image: SolvedImage) -> tuple[RowMotion, Pose]:
    """The steady motion that is nearest, and its pose."""
    assert image.R_cw is not None
    assert image.center_w is not None
    motion, rotation, way = _motion(solution, image).steady(*solution.cameras[image.camera_id].clock_range)
    return motion, (rotation @ image.R_cw, image.center_w + way)


def _line(camera: Camera, place: float, border: float = 0.5) -> float:
    """The line at a place of the readout, from -0.5 where it begins to 0.5 where it ends.

    It begins at the border of the photo, or with `border` 0 at the centre of the line that is read first.
    """
    last = camera.num_lines - 1.0
    return last / 2 + camera.clock_sign * place * (last + 2 * border)


def _clock(camera: Camera, place: float, border: float = 0.5) -> float:
    """The clock there."""
    return float(clock_of(camera, np.full((1, 2), _line(camera, place, border)))[0])


def _pose(solution: Solution, image: SolvedImage, place: float, border: float = 0.5) -> Pose:
    """The pose there, of the steady motion that is nearest."""
    motion, pose = _steady(solution, image)
    return motion.pose_at(_clock(solution.cameras[image.camera_id], place, border), *pose)


def end_poses(solution: Solution, image: SolvedImage) -> tuple[Pose, Pose]:
    """R_cw and center_w at the centres of the lines of a photo that are read first and last.

    Of the steady motion that is nearest; `image` is in the stored frame.
    """
    return _pose(solution, image, -0.5, border=0.0), _pose(solution, image, 0.5, border=0.0)


def _bent(solution: Solution, image: SolvedImage, place: float) -> Pose:
    """The pose that the line at a place has, and not that of the nearest steady motion."""
    assert image.R_cw is not None
    assert image.center_w is not None
    clock = _clock(solution.cameras[image.camera_id], place, border=0.0)
    return _motion(solution, image).pose_at(clock, image.R_cw, image.center_w)


def _viewmat(pose: Pose) -> Array:
    R_cw, center_w = pose
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R_cw, -R_cw @ center_w
    return matrix


def _write_gsplat(path: Path, solution: Solution, images: Sequence[SolvedImage], cameras: Sequence[Camera]) -> None:
    """Arguments of gsplat's `rasterization`, a row for each photo."""
    ends = [[_viewmat(pose) for pose in end_poses(solution, image)] for image in images]
    viewmats = np.array(ends).reshape(-1, 2, 4, 4)
    lines: dict[str, Any] = {}
    if any(_motion(solution, image).bend is not None for image in images):
        places = np.linspace(-0.5, 0.5, _LINES)
        lines = {
            "lines": np.array([[_line(camera, place, border=0.0) for place in places] for camera in cameras]),
            "viewmats_lines": np.array(
                [[_viewmat(_bent(solution, image, place)) for place in places] for image in images]
            ),
        }
    Ks = np.array([camera.K for camera in cameras]).reshape(-1, 3, 3)
    Ks[:, :2, 2] += 0.5  # its pixel centres are at 0.5

    def lens(*names: str) -> Array:
        rows = [[camera.coefficients.get(name, 0.0) for name in names] for camera in cameras]
        return np.array(rows).reshape(-1, len(names))

    radial = lens("k1", "k2", "k3", "k4", "k5", "k6")
    np.savez(
        path,
        names=np.array([image.name for image in images], np.str_),
        viewmats=viewmats[:, 0],
        viewmats_rs=viewmats[:, 1],
        # names of gsplat's `RollingShutterType`, which Python and C++ number apart
        rolling_shutter=np.array([f"ROLLING_{c.readout.upper().replace('-', '_')}" for c in cameras], np.str_),
        Ks=Ks,
        width=np.array([camera.width for camera in cameras], np.int64),
        height=np.array([camera.height for camera in cameras], np.int64),
        camera_model=np.array([camera.lens for camera in cameras], np.str_),
        radial_coeffs=radial,
        tangential_coeffs=lens("p1", "p2"),
        thin_prism_coeffs=lens("s1", "s2", "s3", "s4"),
        **lines,
    )


def _readout_time(solution: Solution, images: Sequence[SolvedImage]) -> tuple[float, str] | None:
    """The time that 3dgs-deblur is given for all photos, and its unit; None where it cannot follow."""
    used = {image.camera_id for image in images}
    if any(solution.cameras[key].clock_axis == 0 for key in used):
        return None  # it knows of rows only
    known = solution.quality.get("readout_times") or {}
    seconds = {known[key]["ms"] / 1e3 if key in known else None for key in used}
    only = seconds.pop() if len(seconds) == 1 else None
    return (1.0, "readout of a frame") if only is None else (only, "second")


def _velocities(solution: Solution, image: SolvedImage, camera: Camera, time: float) -> dict[str, Any]:
    """Velocities of the camera in its own frame, OpenGL's axes: world units and radians by the unit of time."""
    motion, _ = _steady(solution, image)
    R_cw, _ = _pose(solution, image, 0.0)
    # rows run downwards there; to read them upwards is to move the other way
    rate = camera.clock_sign * camera.frame_span / time
    axes = np.array([1.0, -1.0, -1.0])
    return {
        "camera_linear_velocity": (rate * axes * (R_cw @ motion.velocity)).tolist(),
        # phi takes the world to the camera
        "camera_angular_velocity": (-rate * axes * motion.phi).tolist(),
    }
