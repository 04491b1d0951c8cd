"""Metashape's `cameras.xml`: its lens formulas, its transforms, what is measured for it, and damaged files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import RectifyOptions, read_solution
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import FileError, FormatError, InputError, ReconstructionError, RsUndistortWarning
from rsundistort.io.export_scene import ExportScene
from rsundistort.io.metashape import named, read_metashape, write_metashape, write_posed_photos
from rsundistort.model.projection import project_points
from rsundistort.solve.from_poses import measured, posed_photos, shutter_terms

W, H = 1200, 900
COURTYARD = Path(__file__).parent.parent / "sample_scenes" / "courtyard"
FRAME = {"f": 1000.0, "cx": 7.5, "cy": -4.25, "b1": 1.5, "k1": -0.12, "k2": 0.05, "k3": -0.01, "p1": 1e-3, "p2": -5e-4}
FISHEYE = {"f": 600.0, "cx": -3.0, "cy": 2.0, "k1": 0.02, "k2": -0.01, "k3": 2e-3, "k4": -3e-4}


def xml(lens, kind="frame", transform="", label="a", matrix=None, more=""):
    pose = " ".join(map(str, np.eye(4).ravel() if matrix is None else matrix))
    values = "".join(f"<{name}>{value!r}</{name}>" for name, value in lens.items())
    return (
        f'<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">'
        f'<sensor id="0" label="x" type="{kind}"><resolution width="{W}" height="{H}"/>'
        f'<property name="rolling_shutter" value="true"/><property name="rolling_shutter_flags" value="63"/>'
        f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{W}" height="{H}"/>{values}</calibration>'
        f'</sensor></sensors><cameras next_id="2"><group><camera id="0" sensor_id="0" label="{label}">'
        f"<transform>{pose}</transform></camera></group>{more}"
        f'<camera id="1" sensor_id="0" label="lost"/></cameras>{transform}</chunk></document>'
    )


def write(path, *args, **options):
    path.write_text(xml(*args, **options))
    return path


def pixels(lens, fisheye, points):
    """The formulas of Metashape's manual, appendix "Camera models", one point at a time; integer centres."""
    p = dict.fromkeys(("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"), 0.0) | lens
    found = []
    for X, Y, Z in points:
        x, y = X / Z, Y / Z
        if fisheye:
            r0 = np.hypot(x, y)
            x, y = (x * np.arctan(r0) / r0, y * np.arctan(r0) / r0)
        r = np.hypot(x, y)
        bend = 1 + p["k1"] * r**2 + p["k2"] * r**4 + p["k3"] * r**6 + p["k4"] * r**8
        more = 1 + p["p3"] * r**2 + p["p4"] * r**4
        xx = x * bend + (p["p1"] * (r**2 + 2 * x**2) + 2 * p["p2"] * x * y) * more
        yy = y * bend + (p["p2"] * (r**2 + 2 * y**2) + 2 * p["p1"] * x * y) * more
        u = W * 0.5 + p["cx"] + xx * p["f"] + xx * p["b1"] + yy * p["b2"]
        found.append((u - 0.5, H * 0.5 + p["cy"] + yy * p["f"] - 0.5))
    return np.array(found)


@pytest.mark.parametrize(
    ("lens", "kind", "tolerance"),
    [
        (FRAME, "frame", 1e-9),
        (FISHEYE, "equidistant_fisheye", 1e-9),
        (FRAME | {"k4": 3e-3}, "frame", 0.05),
        (FRAME | {"p3": 0.2, "p4": -0.1}, "frame", 0.05),
    ],
)
def test_a_lens_shows_points_where_metashape_does(tmp_path, lens, kind, tolerance):
    camera = read_metashape(write(tmp_path / "cameras.xml", lens, kind)).cameras[0]
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1.2], (50, 3))
    found, valid = project_points(points, camera, None, "global")
    assert valid.all()
    np.testing.assert_allclose(found, pixels(lens, kind != "frame", points), atol=tolerance)


def test_the_transform_of_the_chunk_is_applied(tmp_path):
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    pose = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose, [1.0, 2.0, 3.0]
    said = " ".join(map(repr, turn.ravel().tolist()))
    transform = (
        f"<transform><rotation>{said}</rotation><translation>10 20 30</translation><scale>2.5</scale></transform>"
    )
    found = read_metashape(write(tmp_path / "c.xml", FRAME, transform=transform, matrix=matrix.ravel()))
    np.testing.assert_allclose(found.R_cw[0], (turn @ pose).T, atol=1e-12)
    np.testing.assert_allclose(found.center_w[0], 2.5 * turn @ [1, 2, 3] + [10, 20, 30], atol=1e-12)
    assert found.unposed == ("lost",)


def project():
    """A file as Metashape 2 exports it with rolling-shutter compensation: two photos with its terms, one without."""
    terms = (
        "<rolling_shutter><rotation>9.9999812e-01 1.7e-03 -9.1e-04 -1.7e-03 9.9999855e-01 2.2e-04 9.1e-04 -2.2e-04 "
        "9.9999956e-01</rotation><translation>-3.1415926535897931e-02 1.2e-01 4.4e-03</translation></rolling_shutter>"
    )
    plane = "<rolling_shutter><translation>0.02 -0.11 0</translation></rolling_shutter>"
    photo = (
        '<camera id="{}" sensor_id="4" component_id="0" label="{}">'
        "<transform>1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
        "<rotation_covariance>1e-8 0 0 0 1e-8 0 0 0 1e-8</rotation_covariance>"
        "<location_covariance>1e-4 0 0 0 1e-4 0 0 0 1e-4</location_covariance>{}<orientation>1</orientation>"
        '<reference x="9.5" y="46.5" z="512.25" enabled="true" rotation_enabled="false"/></camera>'
    )
    cameras = photo.format(7, "DJI_0151", 0.125, terms) + photo.format(8, "DJI_0152", 1.5, "")
    cameras += photo.format(11, "DJI_0153", 3, plane)
    values = "".join(f"<{name}>{value!r}</{name}>" for name, value in (FRAME | {"b2": 0.01}).items())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="5"><sensor id="4" label="FC220 (4.73mm)" type="frame">'
        f'<resolution width="{W}" height="{H}"/>'
        '<property name="pixel_width" value="0.0016"/><property name="focal_length" value="4.73"/>'
        '<property name="layer_index" value="0"/><property name="rolling_shutter" value="true"/>'
        '<property name="rolling_shutter_flags" value="63"/><bands><band label="Red"/></bands>'
        f'<data_type>uint8</data_type><calibration type="frame" class="adjusted"><resolution width="{W}" height="{H}"/>'
        f"{values}</calibration><black_level>0 0 0</black_level></sensor></sensors>"
        '<components next_id="1"><component id="0" label="Component 1"><transform><rotation locked="true">'
        "1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>4</scale></transform></component>"
        f'</components><cameras next_id="12" next_group_id="0">{cameras}</cameras></chunk></document>'
    )


def test_what_nobody_explains_of_a_shutter_is_kept_as_it_is(tmp_path):
    (tmp_path / "c.xml").write_text(project())
    found = read_metashape(tmp_path / "c.xml")
    assert sorted(found.shutter) == [0, 2]
    # lengths follow the scale of the component, as centres do; rotations do not
    np.testing.assert_array_equal(found.shutter[0].translation, 4 * np.array([-3.1415926535897931e-02, 0.12, 4.4e-3]))
    assert found.shutter[0].rotation[0, 1] == 1.7e-3
    np.testing.assert_array_equal(found.shutter[2].rotation, np.eye(3))
    np.testing.assert_allclose(found.center_w[:, 0], [0.5, 6, 12])
    assert found.sensors[0].shutter == {"rolling_shutter": "true", "rolling_shutter_flags": "63"}


def test_a_file_read_and_written_is_the_same(tmp_path):
    (tmp_path / "c.xml").write_text(project())
    first = read_metashape(tmp_path / "c.xml")
    write_posed_photos(tmp_path / "again.xml", first)
    second = read_metashape(tmp_path / "again.xml")
    assert second.labels == first.labels == ("DJI_0151", "DJI_0152", "DJI_0153")
    assert second.camera_ids == first.camera_ids == (5,)
    assert second.sensors == first.sensors
    np.testing.assert_array_equal(second.center_w, first.center_w)
    np.testing.assert_allclose(second.R_cw, first.R_cw, atol=1e-15)
    assert second.shutter.keys() == first.shutter.keys()
    for key, terms in first.shutter.items():
        np.testing.assert_array_equal(second.shutter[key].rotation, terms.rotation)
        np.testing.assert_array_equal(second.shutter[key].translation, terms.translation)


def test_info_shows_the_terms_and_says_why_they_are_not_used(tmp_path):
    (tmp_path / "c.xml").write_text(project())
    shown = CliRunner().invoke(cli, ["info", str(tmp_path / "c.xml")])
    assert shown.exit_code == 0, shown.output
    assert re.search(r"photos with rolling_shutter +2\n", shown.output)
    assert "-0.125664 0.48 0.0176" in shown.output
    assert "Not used as motion: Agisoft does not publish" in shown.output
    refused = CliRunner().invoke(cli, ["info", str(tmp_path / "photo.jpg")])
    assert refused.exit_code == 1
    assert "photo.jpg is no cameras.xml of Metashape" in refused.stderr
    held = json.loads(CliRunner().invoke(cli, ["info", str(tmp_path / "c.xml"), "--json"]).output)
    assert held["rolling_shutter"]["DJI_0153"]["translation"] == [0.08, -0.44, 0.0]
    assert held["rolling_shutter"]["DJI_0153"]["angle_deg"] == 0
    assert held["cameras"]["5"]["rolling_shutter_flags"] == "63"


def test_a_solution_keeps_the_terms_and_has_no_motion_of_them(tmp_path):
    (tmp_path / "c.xml").write_text(project())
    (tmp_path / "photos").mkdir()
    for name in ("DJI_0151.JPG", "DJI_0152.JPG", "DJI_0153.JPG"):
        cv2.imwrite(str(tmp_path / "photos" / name), np.zeros((8, 8), np.uint8))
    with pytest.warns(RsUndistortWarning, match=r"rolling_shutter of 2 photos, such as DJI_0151\.JPG, .* not used as"):
        posed = posed_photos(tmp_path / "c.xml", tmp_path / "photos", "tif")
    kept = shutter_terms(posed)
    assert sorted(kept) == ["DJI_0151.JPG", "DJI_0153.JPG"]
    assert kept["DJI_0153.JPG"] == {"rotation": np.eye(3).tolist(), "translation": [0.08, -0.44, 0.0]}


def test_geocentric_coordinates_are_counted_from_the_middle(tmp_path):
    matrix = np.eye(4)
    matrix[:3, 3] = [4_000_000.25, 500_000.5, 4_900_000.75]
    with pytest.warns(RsUndistortWarning, match="counted from 4000000, 500000, 4900001"):
        found = read_metashape(write(tmp_path / "c.xml", FRAME, matrix=matrix.ravel()))
    np.testing.assert_allclose(found.center_w[0], [0.25, 0.5, -0.25], atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<document>", "is no valid XML"),
        ("<document/>", "holds no chunk"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><document>&a;</document>', "declares a document type"),
        ('<!DOCTYPE x SYSTEM "http://localhost/x.dtd"><document/>', "declares a document type"),
        ("<a>" * 5000 + "</a>" * 5000, "nested deeper"),
        (xml(FRAME | {"f": -1.0}), "focal length -1"),
        (xml({}), "focal length 0"),
        (xml(FRAME, "spherical"), "is spherical, expected frame or fisheye"),
        (xml(FRAME | {"b2": 9.0}), r"has b2, which no camera of ours follows to 0\.05 px \(to [\d.]+ px\)"),
        (xml(FRAME, matrix=range(16)), "transform is no pose|rotation"),
        (xml(FRAME, matrix=np.diag([1, 1, -1, 1]).ravel()), "no pose|rotation"),
        (xml(FRAME, matrix=["x"] * 16), "could not convert"),
        (xml(FRAME, matrix=[1.0] * 3), "expected 16 numbers, got 3"),
        (xml(FRAME).replace('sensor_id="0"', 'sensor_id="7"'), "'7' is missing"),
        (xml(FRAME).replace('label="a"', ""), "'label' is missing"),
        (
            project().replace("0.02 -0.11 0", "0.02 -0.11"),
            "rolling_shutter of DJI_0153: translation: expected 3 numbers",
        ),
        (project().replace("9.9999855e-01", "nan"), "rolling_shutter of DJI_0151: rotation: expected 9 numbers"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, text, message):
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        read_metashape(tmp_path / "cameras.xml")
    assert len(str(caught.value).splitlines()) == 1
    assert "cameras.xml" in str(caught.value)


def test_a_billion_laughs_take_no_time_and_leave_nothing(tmp_path):
    levels = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
    (tmp_path / "cameras.xml").write_text(f'<!DOCTYPE d [<!ENTITY l0 "ha">{levels}]><document>&l9;</document>')
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "a.png"), np.zeros((8, 8), np.uint8))
    args = ["solve", str(tmp_path / "cameras.xml"), "--images", str(tmp_path / "photos"), "-o", str(tmp_path / "out")]
    result = CliRunner().invoke(cli, args)
    assert result.exit_code == 1
    assert "declares a document type" in result.output
    assert not (tmp_path / "out").exists()


def test_without_photos_it_says_what_is_needed(tmp_path):
    with pytest.raises(InputError, match=r"no measurements; say where the photos are \(--images\)"):
        posed_photos(write(tmp_path / "cameras.xml", FRAME), None, "tif")
    with pytest.raises(FileError, match="cannot be read"):
        read_metashape(tmp_path / "none.xml")


def test_photos_are_found_by_name_without_ending_or_folder(tmp_path):
    posed = read_metashape(write(tmp_path / "c.xml", FRAME, label="DJI_0151"))
    assert named(posed, ["x.jpg", "day1/DJI_0151.JPG"], "photos").labels == ("day1/DJI_0151.JPG",)
    with pytest.raises(InputError, match="photos holds 2 photos called 'DJI_0151'"):
        named(posed, ["day1/DJI_0151.JPG", "day2/DJI_0151.JPG"], "photos")
    with pytest.raises(InputError, match="photos holds no photo called 'DJI_0151'"):
        named(posed, ["x.jpg"], "photos")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Three small photos of courtyard, and what Metashape would say of their global-shutter references."""
    place = tmp_path_factory.mktemp("metashape")
    (place / "photos").mkdir()
    truth = read_solution(COURTYARD / "ground_truth.json")
    for name in (names := [image.name for image in truth.images[1:4]]):
        picture = cv2.imread(str(COURTYARD / "global" / name), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(place / "photos" / name), picture)
    write_metashape(place, ExportScene(truth, None, {name: name for name in names}, None, truth))
    return place, truth


def measure(place, posed, work):
    return measured(posed, place / "photos", RectifyOptions(), 0, Workers(1), work, StageLog(None))


def test_photos_are_measured_where_the_poses_say(small, tmp_path):
    place, truth = small
    posed = posed_photos(place / "cameras.xml", place / "photos", "tif")
    model, track_source = measure(place, posed, tmp_path)
    rec = model.reconstruction
    assert len(track_source.matched.names) == 3
    assert rec.num_points > 300
    for name, R, center in zip(rec.image_names, rec.R_cw, rec.center_w, strict=True):
        np.testing.assert_allclose(R, truth.image(name).R_cw, atol=1e-9)
        np.testing.assert_allclose(center, truth.image(name).center_w, atol=1e-9)
    tracks = np.load(COURTYARD / "tracks.npz")
    depth = (rec.points_w - rec.center_w[0]) @ rec.R_cw[0, 2]
    true = (tracks["points_w"] - rec.center_w[0]) @ rec.R_cw[0, 2]
    assert np.percentile(depth, 5) > 0.5 * true[true > 0].min()
    assert np.percentile(depth, 95) < 1.5 * true.max()


def test_poses_of_other_photos_are_refused(small, tmp_path):
    place, _ = small
    posed = posed_photos(place / "cameras.xml", place / "photos", "tif")
    wrong = type(posed)(**{**vars(posed), "R_cw": posed.R_cw[[1, 2, 0]], "center_w": posed.center_w[[2, 0, 1]]})
    with pytest.raises(ReconstructionError, match="the poses explain"):
        measure(place, wrong, tmp_path)
