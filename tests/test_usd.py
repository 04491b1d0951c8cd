"""The camera of a video as USD, opened by USD's own library."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RunOptions, run
from rsundistort.errors import InputError
from rsundistort.io.usd import write_usd_camera
from rsundistort.model.track import CameraTrack
from rsundistort.solve import OutputOptions

pytest.importorskip("pxr")


@pytest.fixture
def stage(tmp_path: Path):  # type: ignore[no-untyped-def]
    from pxr import Usd

    rng = np.random.default_rng(5)
    time = np.array([0.0, 1.0, 2.0, 4.0]) / 25
    R_cw = Rotation.from_rotvec(rng.normal(0, 0.2, (4, 3))).as_matrix()
    camera = Camera(640, 360, [[500, 0, 333.3], [0, 505, 171.2], [0, 0, 1]])
    track = CameraTrack(time, 1 / 25, R_cw, rng.normal(0, 1, (4, 3)), camera)
    points_w = np.column_stack([rng.uniform(-1, 1, (30, 2)), rng.uniform(6, 12, 30)])
    write_usd_camera(tmp_path / "camera.usda", track, points_w)
    return Usd.Stage.Open(str(tmp_path / "camera.usda")), camera, track, points_w


def test_its_camera_projects_points_where_ours_does(stage) -> None:  # type: ignore[no-untyped-def]
    from pxr import Gf, UsdGeom

    opened, camera, track, points_w = stage
    prim = UsdGeom.Camera(opened.GetPrimAtPath("/World/Camera"))
    theirs = UsdGeom.Points(opened.GetPrimAtPath("/World/Points")).GetPointsAttr().Get()
    for k, code in enumerate((0.0, 1.0, 2.0, 4.0)):
        frustum = prim.GetCamera(code).frustum
        view = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        ndc = np.array([view.Transform(Gf.Vec3d(*each)) for each in theirs])
        found = np.column_stack([(ndc[:, 0] + 1) / 2 * camera.width, (1 - ndc[:, 1]) / 2 * camera.height]) - 0.5
        x_c = (points_w - track.center_w[k]) @ track.R_cw[k].T
        expected = (x_c / x_c[:, 2:]) @ camera.K[:2].T
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_its_time_codes_are_frames(stage) -> None:  # type: ignore[no-untyped-def]
    opened, *_ = stage
    assert opened.GetTimeCodesPerSecond() == pytest.approx(25)
    assert (opened.GetStartTimeCode(), opened.GetEndTimeCode()) == pytest.approx((0, 4))
    assert str(opened.GetDefaultPrim().GetPath()) == "/World"


def test_photos_have_no_path_to_write(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="--usd is for a video"):
        run(tmp_path / "photos", tmp_path / "out", RunOptions(outputs=OutputOptions(usd=True)))
    assert not (tmp_path / "out").exists()
