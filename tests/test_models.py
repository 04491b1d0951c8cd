"""Models of OpenMVG and OpenSfM, made by hand from a known truth by the conventions that these document."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.io.models import read_model
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.solve import SolveOptions, solve

W, H = 640, 480
F, CX, CY = 500.0, 322.0, 236.5  # integer pixel centres
NONE = 4294967295  # OpenMVG's id for none


def project(points_w, R, center, dist, fisheye, fy, middle, phi):
    """Pixels with integer centres, by OpenCV; of a camera that rotates, by the row that it finds after some rounds."""
    K = np.array([[F, 0, middle[0]], [0, fy, middle[1]], [0, 0, 1.0]])
    points = (points_w - center) @ R.T

    def seen_of(q):
        if fisheye:
            return cv2.fisheye.projectPoints(q[:, None], np.zeros(3), np.zeros(3), K, dist)[0].reshape(-1, 2)
        return cv2.projectPoints(q, np.zeros(3), np.zeros(3), K, dist)[0].reshape(-1, 2)

    xy = seen_of(points)
    for _ in range(20 if phi.any() else 0):
        r = (xy[:, 1] - middle[1]) / fy
        xy = seen_of(np.einsum("nij,nj->ni", Rotation.from_rotvec(r[:, None] * phi).as_matrix(), points))
    return xy


class Truth:
    """Photos around a scene, and where they show its points."""

    def __init__(self, dist, fisheye=False, num=4, points=50, fy=F, middle=(CX, CY), turning=0.0):
        rng = np.random.default_rng(3)
        self.R = Rotation.from_rotvec(rng.normal(0, 0.15, (num, 3))).as_matrix()
        self.center = rng.normal(0, 1, (num, 3)) * [1, 1, 0.3]
        self.points = np.column_stack([rng.uniform(-2, 2, (points, 2)), rng.uniform(6, 10, points)])
        self.colors = rng.integers(0, 256, (points, 3))
        self.names = ["walk/b.jpg", *(f"{k}.jpg" for k in range(num - 1))]
        self.phi = rng.normal(0, turning, (num, 3))
        self.xy = [
            project(self.points, self.R[i], self.center[i], np.array(dist), fisheye, fy, middle, self.phi[i])
            for i in range(num)
        ]
        self.seen = [np.flatnonzero(((xy > 0) & (xy < [W - 1, H - 1])).all(1)) for xy in self.xy]


def openmvg(truth, lens):
    """`sfm_data.json` as OpenMVG writes it, ids from 0; one view more without a pose."""
    views = []
    for i, name in enumerate([*truth.names, "lost.jpg"]):
        folder, _, file = name.rpartition("/")
        posed = i < len(truth.names)
        data = {
            "local_path": f"{folder}/", "filename": file, "width": W, "height": H, "id_view": i,
            "id_intrinsic": 0 if posed else NONE, "id_pose": i if posed else NONE,
        }  # fmt: skip
        views.append({"key": i, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": i, "data": data}}})
    camera = {"width": W, "height": H, "focal_length": F, "principal_point": [CX, CY]}
    camera = {"value0": camera, **lens} if "disto_t2" in lens else {**camera, **lens}
    poses = zip(truth.R, truth.center, strict=True)
    points = []
    for p, X in enumerate(truth.points):
        seen = [
            {"key": i, "value": {"id_feat": 100 + p, "x": truth.xy[i][p].tolist()}}
            for i in range(len(truth.names))
            if p in truth.seen[i]
        ]
        points.append({"key": 7 + p, "value": {"X": X.tolist(), "observations": seen}})
    return {
        "sfm_data_version": "0.3",
        "root_path": "photos",
        "views": views,
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": 9, "data": camera}}}],
        "extrinsics": [
            {"key": i, "value": {"rotation": R.tolist(), "center": c.tolist()}} for i, (R, c) in enumerate(poses)
        ],
        "structure": points,
        "control_points": [],
    }


def opensfm(truth, camera, version="v2"):
    """`reconstruction.json` and `tracks.csv`: coordinates from the middle, in units of the longer side."""
    shots = {
        name: {
            "rotation": Rotation.from_matrix(R).as_rotvec().tolist(),
            "translation": (-R @ c).tolist(),
            "camera": "v2 x",
        }
        for name, R, c in zip(truth.names, truth.R, truth.center, strict=True)
    }
    points = {
        str(2 * p): {"color": color.tolist(), "coordinates": X.tolist()}
        for p, (X, color) in enumerate(zip(truth.points, truth.colors, strict=True))
    }
    lines = [] if version == "v0" else [f"OPENSFM_TRACKS_VERSION_{version}"]
    rest = {"v0": "1\t2\t3", "v1": "0.004\t1\t2\t3", "v2": "0.004\t1\t2\t3\t-1\t-1"}[version]
    for i, name in enumerate(truth.names):
        for p in truth.seen[i]:
            x, y = (truth.xy[i][p] + 0.5 - np.array([W, H]) / 2) / max(W, H)
            lines.append(f"{name}\t{2 * p}\t{100 + p}\t{x:.12f}\t{y:.12f}\t{rest}")
    lines += [f"lost.jpg\t0\t1\t0.1\t0.1\t{rest}", f"{truth.names[0]}\t99999\t1\t0.1\t0.1\t{rest}"]
    value = [{"cameras": {"v2 x": {"width": W, "height": H, **camera}}, "shots": shots, "points": points}]
    return value, "\n".join(lines) + "\n"


def write_opensfm(folder, *made):
    value, tracks = opensfm(*made)
    (folder / "reconstruction.json").write_text(json.dumps(value))
    (folder / "tracks.csv").write_text(tracks)
    return folder / "reconstruction.json"


def check(model, truth):
    """The model is the truth: every measurement where the point projects, in the order of names."""
    rec = model.reconstruction
    assert sorted(rec.image_names) == sorted(truth.names)
    assert list(model.unregistered) == ["lost.jpg"]
    assert model.self_calibrated
    for i, name in enumerate(rec.image_names):
        k = truth.names.index(name)
        np.testing.assert_allclose(rec.R_cw[i], truth.R[k], atol=1e-12)
        np.testing.assert_allclose(rec.center_w[i], truth.center[k], atol=1e-12)
    twice = np.bincount(np.concatenate(truth.seen), minlength=len(truth.points)) >= 2
    np.testing.assert_array_equal(rec.points_w, truth.points[twice])
    assert len(rec.observations) == sum(twice[seen].sum() for seen in truth.seen) > 60
    assert len(model.keypoint_idx) == len(rec.observations)
    np.testing.assert_array_equal(model.keypoint_idx, 100 + np.flatnonzero(twice)[rec.observations.point_idx])
    residuals, valid = reprojection_residuals(rec)
    assert valid.all()
    assert np.abs(residuals).max() < 1e-6
    return twice


@pytest.mark.parametrize(
    ("lens", "dist", "fisheye"),
    [
        ({}, (0, 0, 0, 0), False),
        ({"disto_k1": [-0.1]}, (-0.1, 0, 0, 0), False),
        ({"disto_k3": [-0.1, 0.03, -0.01]}, (-0.1, 0.03, 0, 0, -0.01), False),
        ({"disto_t2": [-0.1, 0.03, -0.01, 1e-3, -2e-3]}, (-0.1, 0.03, 1e-3, -2e-3, -0.01), False),
        ({"fisheye": [0.02, -0.01, 0.004, -0.001]}, (0.02, -0.01, 0.004, -0.001), True),
    ],
)
def test_openmvg_is_read_with_all_its_lenses(tmp_path, lens, dist, fisheye):
    truth = Truth(dist, fisheye)
    (tmp_path / "sfm_data.json").write_text(json.dumps(openmvg(truth, lens)))
    model = read_model(tmp_path / "sfm_data.json")
    twice = check(model, truth)
    assert model.camera_ids.tolist() == [1]
    assert model.image_ids.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(model.point_ids, 8 + np.flatnonzero(twice))
    assert not model.has_colors


UNIT = F / W
MIDDLE = {"c_x": (CX + 0.5 - W / 2) / W, "c_y": (CY + 0.5 - H / 2) / W}


@pytest.mark.parametrize(
    ("camera", "dist", "fisheye"),
    [
        ({"projection_type": "brown", "focal_x": UNIT, "focal_y": UNIT * 1.01, **MIDDLE, "k1": -0.1, "k2": 0.03,
          "p1": 1e-3, "p2": -2e-3, "k3": -0.01}, (-0.1, 0.03, 1e-3, -2e-3, -0.01), False),
        ({"projection_type": "simple_radial", "focal_x": UNIT, "focal_y": UNIT * 1.01, **MIDDLE, "k1": -0.1},
         (-0.1, 0, 0, 0), False),
        ({"projection_type": "radial", "focal_x": UNIT, "focal_y": UNIT * 1.01, **MIDDLE, "k1": -0.1, "k2": 0.03},
         (-0.1, 0.03, 0, 0), False),
        ({"projection_type": "fisheye_opencv", "focal_x": UNIT, "focal_y": UNIT * 1.01, **MIDDLE, "k1": 0.02,
          "k2": -0.01, "k3": 0.004, "k4": -0.001}, (0.02, -0.01, 0.004, -0.001), True),
    ],
)  # fmt: skip
def test_opensfm_is_read_with_cameras_of_their_own_middle(tmp_path, camera, dist, fisheye):
    truth = Truth(dist, fisheye, fy=1.01 * F)
    model = read_model(write_opensfm(tmp_path, truth, camera))
    twice = check(model, truth)
    np.testing.assert_array_equal(model.colors, truth.colors[twice])
    np.testing.assert_array_equal(model.point_ids, 1 + 2 * np.flatnonzero(twice))


@pytest.mark.parametrize("version", ["v0", "v1", "v2"])
@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_opensfm_cameras_in_the_middle_and_all_versions_of_tracks(tmp_path, kind, version):
    truth = Truth((-0.1, 0.03, 0, 0), kind == "fisheye", middle=(W / 2 - 0.5, H / 2 - 0.5))
    camera = {"projection_type": kind, "focal": UNIT, "k1": -0.1, "k2": 0.03}
    check(read_model(write_opensfm(tmp_path, truth, camera, version)), truth)


def test_largest_reconstruction_of_opensfm_is_taken(tmp_path):
    truth = Truth((0, 0, 0, 0))
    value, tracks = opensfm(truth, {"projection_type": "brown", "focal_x": UNIT, "focal_y": UNIT, **MIDDLE})
    (tmp_path / "tracks.csv").write_text(tracks)
    small = {"cameras": {}, "shots": {"x.jpg": {}}, "points": {}}
    (tmp_path / "r.json").write_text(json.dumps([small, *value]))
    check(read_model(tmp_path / "r.json"), truth)


def test_solve_finds_the_shutter_from_openmvg(tmp_path):
    truth = Truth((-0.1, 0, 0, 0), num=6, points=150, turning=0.05)
    (tmp_path / "sfm_data.json").write_text(json.dumps(openmvg(truth, {"disto_k1": [-0.1]})))
    options = SolveOptions(shutter_model="rotation", refine=(), readout="top-to-bottom", remedy="none")
    solution = solve(tmp_path / "sfm_data.json", tmp_path / "out", options)
    for k, name in enumerate(truth.names):
        np.testing.assert_allclose(solution.image(name).motion.phi, truth.phi[k], atol=2e-3)
    assert solution.image("lost.jpg").reason == "it is not registered in the model"


# ---------------------------------------------------------------- what is no model


BROWN = {"projection_type": "brown", "focal_x": UNIT, "focal_y": UNIT}


def broken_openmvg(change):
    value = openmvg(Truth((0, 0, 0, 0)), {})
    change(value)
    return value


def _set(value, path, new):
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = new


VIEW = ("views", 0, "value", "ptr_wrapper", "data")
CAMERA = ("intrinsics", 0, "value", "ptr_wrapper", "data")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("structure"), "lacks structure"),
        (lambda v: v.update(structure=[]), "0 points, expected more"),
        (lambda v: v.update(extrinsics=[]), "0 photos with a pose"),
        (lambda v: _set(v, (*VIEW, "filename"), "../../a.jpg"), "inside the folder of photos"),
        (lambda v: _set(v, CAMERA, {"width": 9, "height": 9}), "no focal length"),
        (
            lambda v: _set(v, ("extrinsics", 0, "value", "center"), [0, float("nan"), 0]),
            r"extrinsics\[0\].value.center: expected three",
        ),
        (
            lambda v: _set(v, ("extrinsics", 0, "value", "rotation"), [[1, 0], [0, 1]]),
            r"extrinsics\[0\].value.rotation: expected 3 x 3",
        ),
        (
            lambda v: _set(v, ("structure", 0, "value", "X"), [1, 2]),
            r"structure\[0\].value.X: expected three numbers, got \[1, 2\]",
        ),
        (
            lambda v: _set(v, ("structure", 0, "value", "X"), None),
            r"structure\[0\].value.X: expected three numbers, got null",
        ),
        (lambda v: _set(v, (*CAMERA, "disto_k3"), [1.0]), "intrinsic 0.disto_k3: expected three numbers"),
        (lambda v: v.update(views=3), "views: expected a list, got 3"),
    ],
)
def test_broken_openmvg_is_one_line(tmp_path, change, message):
    (tmp_path / "sfm_data.json").write_text(json.dumps(broken_openmvg(change)))
    with pytest.raises(FormatError, match=message) as caught:
        read_model(tmp_path / "sfm_data.json")
    assert "sfm_data.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "tracks", "message"),
    [
        (BROWN, None, "tracks.csv cannot be read"),
        (BROWN, "a.jpg 1 2\n", "line 1: 1 columns"),
        (BROWN, "../../a.jpg\t1\t2\t0\t0\n", "inside the folder of photos"),
        (BROWN, "0.jpg\t0\tx\t0\t0\n", "line 1: invalid literal"),
        ({"projection_type": "spherical"}, "", "projection_type: expected one of perspective.*got 'spherical'"),
        ({"projection_type": "brown"}, "", "has no focal length"),
    ],
)
def test_broken_opensfm_is_one_line(tmp_path, camera, tracks, message):
    value, _ = opensfm(Truth((0, 0, 0, 0)), camera)
    (tmp_path / "reconstruction.json").write_text(json.dumps(value))
    if tracks is not None:
        (tmp_path / "tracks.csv").write_text(tracks)
    with pytest.raises((FormatError, FileError), match=message) as caught:
        read_model(tmp_path / "reconstruction.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"# Bundle file v0.3\n2 3\n", b"{}", b"[]", b"[1]", b"\xff\xfe", b""])
def test_other_files_are_no_model(tmp_path, content):
    (tmp_path / "bundle.out").write_bytes(content)
    with pytest.raises(FormatError, match="is no model; give the folder of a COLMAP model, OpenMVG's"):
        read_model(tmp_path / "bundle.out")


def test_a_database_goes_with_colmap_alone(tmp_path):
    (tmp_path / "sfm_data.json").write_text("{}")
    with pytest.raises(InputError, match="--database is COLMAP's"):
        solve(tmp_path / "sfm_data.json", tmp_path / "out", database=tmp_path / "database.db")


def test_command_leaves_nothing_of_a_model_that_is_none(tmp_path):
    (tmp_path / "model.nvm").write_text("NVM_V3\n")
    result = CliRunner().invoke(cli, ["solve", str(tmp_path / "model.nvm"), "-o", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "is no model" in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()
