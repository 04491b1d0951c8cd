"""The camera of a video as USD, for Blender and other programs that put things into filmed scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.array_types import Array
from ..model.track import CameraTrack

__all__ = ["FILM_WIDTH", "FLIP", "write_usd_camera"]

#: Units of the film back: tenths of a unit of the world by USD's rule, of which only ratios matter.
FILM_WIDTH = 36.0
#: Camera axes of USD (right, up, back) in ours (right, down, ahead).
FLIP = np.diag([1.0, -1.0, -1.0])


def write_usd_camera(path: Path, track: CameraTrack, points_w: Array) -> None:
    """Write a stage with an animated camera, which matches rectified frames, and the points of the scene.

    Parameters
    ----------
    path : Path
        File to write, .usda or .usdc.
    track : CameraTrack
        Camera and poses; time codes are frames, counted from 0 by the times.
    points_w : (n, 3) array
        Points.

    Notes
    -----
    The stage is in the world of the solution rotated so that y is up: x right, y up, z back of the first camera. Its
    film back is as wide as 36 mm, with offsets where the principal point is not in the middle.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    code, rate = track.numbers, round(1.0 / track.frame_s, 6)
    camera = track.camera
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(float(code[0]))
    stage.SetEndTimeCode(float(code[-1]))
    root = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(root.GetPrim())
    prim = UsdGeom.Camera.Define(stage, "/World/Camera")
    mm = FILM_WIDTH / camera.width
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    prim.CreateFocalLengthAttr(float(fx * mm))
    prim.CreateHorizontalApertureAttr(FILM_WIDTH)
    prim.CreateVerticalApertureAttr(float(camera.height * mm * fx / fy))
    prim.CreateHorizontalApertureOffsetAttr(float((camera.width / 2 - (cx + 0.5)) * mm))
    prim.CreateVerticalApertureOffsetAttr(float(((cy + 0.5) - camera.height / 2) * mm * fx / fy))
    size = float(np.median(np.linalg.norm(points_w - track.center_w.mean(0), axis=1))) if len(points_w) else 1.0
    prim.CreateClippingRangeAttr(Gf.Vec2f(1e-3 * size, 1e3 * size))
    pose = prim.AddTransformOp()
    for time, R_cw, center_w in zip(code.tolist(), track.R_cw, track.center_w, strict=True):
        matrix = np.eye(4)  # of row vectors
        matrix[:3, :3] = FLIP @ R_cw @ FLIP
        matrix[3, :3] = FLIP @ center_w
        pose.Set(Gf.Matrix4d(matrix.tolist()), Usd.TimeCode(time))
    cloud = UsdGeom.Points.Define(stage, "/World/Points")
    cloud.CreatePointsAttr([Gf.Vec3f(*each) for each in (points_w @ FLIP).tolist()])
    cloud.CreateWidthsAttr([2e-3 * size])
    cloud.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    prim.GetPrim().CreateAttribute("rsundistort:worldTurned", Sdf.ValueTypeNames.String).Set("y and z negated")
    stage.GetRootLayer().Save()
