"""Positions of photos: GPS of EXIF and XMP, frames on the map, and control points' tables."""

from __future__ import annotations

import sys

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from surveys import ORIGIN, geodetic_of
from test_exif import ascii_, rational, rationals, with_gps

from rsundistort.errors import FormatError, InputError
from rsundistort.input.positions import check_crs, frame_at, frame_of_control, positions_of
from rsundistort.io import ExifFacts, GpsFix, facts_of_exif, read_control_points
from rsundistort.model.geodesy import ecef_from_geodetic, enu_from_geodetic
from rsundistort.model.similarity import Similarity, fit_similarity

PLACE = {1: ascii_("N"), 2: rationals((47, 1), (30, 1), (0, 1)), 3: ascii_("W"), 4: rationals((8, 1), (15, 1), (0, 1))}
DJI = "http://www.dji.com/drone-dji/1.0/"
SENSEFLY = "http://ns.sensefly.com/sensefly/1.0/"
PIX4D = "http://pix4d.com/camera/1.0"
PARROT = "http://www.parrot.com/namespace/drone-parrot/1.0/"


def xmp(namespace, **values):
    attributes = "".join(f' a:{name}="{value}"' for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:a="{namespace}"{attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def fix(packet=b"", entries=PLACE):
    return facts_of_exif(with_gps(entries, "<"), packet).fix


def test_exif_tells_place_altitude_and_speed():
    entries = {**PLACE, 5: (1, 1, b"\x01"), 6: rational(123, 2), 12: ascii_("N"), 13: rational(10, 1)}
    entries |= {14: ascii_("T"), 15: rational(90, 1)}
    found = fix(entries=entries)
    assert (found.latitude_deg, found.longitude_deg, found.altitude_m) == (47.5, -8.25, -61.5)
    assert found.speed_m_s == pytest.approx(10 * 1852 / 3600)
    assert found.velocity_m_s == pytest.approx((10 * 1852 / 3600, 0, 0), abs=1e-9)


@pytest.mark.parametrize(
    ("entries", "packet", "sigma", "sigma_from"),
    [
        ({}, b"", (3.0, 3.0, 5.0), "default"),
        ({11: rational(4, 1)}, b"", (6.0, 6.0, 10.0), "DOP"),
        ({31: rational(151, 10)}, b"", (10.0, 10.0, 17.0), "positioning error"),
        ({11: rational(4, 1)}, xmp(PIX4D, GPSXYAccuracy="0.8", GPSZAccuracy="1.5"), (0.8, 0.8, 1.5), "accuracy"),
        ({}, xmp(DJI, RtkStdLon="0.03", RtkStdLat="0.04", RtkStdHgt="0.09"), (0.03, 0.04, 0.09), "RTK"),
        ({}, xmp(DJI, RtkStdLon="0.003", RtkStdLat="0.04", RtkStdHgt="0.09"), (0.02, 0.04, 0.09), "RTK"),
        ({}, xmp(DJI, RtkStdLon="x", RtkStdLat="0.04", RtkStdHgt="0.09"), (3.0, 3.0, 5.0), "default"),
    ],
)
def test_the_most_direct_statement_of_the_accuracy_counts(entries, packet, sigma, sigma_from):
    found = fix(packet, {**PLACE, **entries})
    assert found.sigma_m == pytest.approx(sigma, rel=0.01)
    assert found.sigma_from == sigma_from


def test_xmp_of_drones_tells_height_and_velocity():
    dji = fix(
        xmp(
            DJI,
            AbsoluteAltitude="+412.5",
            RelativeAltitude="+60",
            FlightXSpeed="3",
            FlightYSpeed="4",
            FlightZSpeed="-1",
        )
    )
    assert (dji.altitude_m, dji.height_m, dji.velocity_m_s, dji.speed_m_s) == (412.5, 60.0, (4.0, 3.0, 1.0), 5.0)
    alone = facts_of_exif(
        b"", xmp(SENSEFLY, Latitude="41.03", Longitude="-83.3", AltitudeWGS84="283.8", GroundSpeed="3")
    )
    assert (alone.fix.latitude_deg, alone.fix.longitude_deg, alone.fix.altitude_m) == (41.03, -83.3, 283.8)
    assert alone.fix.speed_m_s == 3.0


@pytest.mark.parametrize(
    ("angles", "right", "ahead"),
    [
        ((0, -90, 0), (1, 0, 0), (0, 0, -1)),
        ((90, 0, 0), (0, -1, 0), (1, 0, 0)),
        ((-90, -45, 0), (0, 1, 0), (-(0.5**0.5), 0, -(0.5**0.5))),
        ((0.01, 0, 90), (0, 0, -1), (0, 1, 0)),
    ],
)
@pytest.mark.parametrize(("namespace", "prefix"), [(DJI, "Gimbal"), (PARROT, "Camera")])
def test_a_gimbal_tells_where_the_camera_looked(namespace, prefix, angles, right, ahead):
    names = (f"{prefix}YawDegree", f"{prefix}PitchDegree", f"{prefix}RollDegree")
    found = fix(xmp(namespace, **{name: f"{value:+}" for name, value in zip(names, angles, strict=True)}))
    R_cw = positions_of(["a.jpg"], [ExifFacts(fix=found)]).R_cw[0]
    np.testing.assert_allclose(R_cw[[0, 2]], [right, ahead], atol=2e-4)
    assert np.linalg.det(R_cw) == pytest.approx(1.0)
    assert np.isnan(positions_of(["a.jpg"], [ExifFacts(fix=found, orientation=6)]).R_cw).all()


@pytest.mark.parametrize(
    ("namespace", "names"),
    [
        ("http://pix4d.com/camera/1.0/", ("Yaw", "Pitch", "Roll")),
        ("http://ns.sensefly.com/Camera/1.0/", ("Yaw", "Pitch", "Roll")),
        ("http://ns.sensefly.com/sensefly/1.0/", ("Heading", "PitchAngle", "RollAngle")),
    ],
)
@pytest.mark.parametrize(
    ("angles", "right", "ahead"),
    [
        ((360, 0, 0), (1, 0, 0), (0, 0, -1)),
        ((90, 0, 0), (0, -1, 0), (0, 0, -1)),
        ((0, 90, 0), (1, 0, 0), (0, 1, 0)),  # a pitch of 90 degrees looks at the horizon
        ((-90, 45, 0), (0, 1, 0), (-(0.5**0.5), 0, -(0.5**0.5))),
        ((0, 0, 30), (0.75**0.5, 0, -0.5), (-0.5, 0, -(0.75**0.5))),  # the right side down, the view to the left
    ],
)
def test_the_attitude_of_a_camera_that_looks_down(namespace, names, angles, right, ahead):
    packet = xmp(namespace, **{name: str(value) for name, value in zip(names, angles, strict=True)})
    R_cw = np.array(fix(packet).R_cw)
    np.testing.assert_allclose(R_cw[[0, 2]], [right, ahead], atol=1e-12)
    assert np.linalg.det(R_cw) == pytest.approx(1.0)


def test_a_gimbal_of_zeros_is_none():
    assert fix(xmp(DJI, GimbalYawDegree="0", GimbalPitchDegree="0", GimbalRollDegree="0")).R_cw is None


def test_xmp_with_entities_is_not_looked_at():
    packet = b'<!DOCTYPE x [<!ENTITY a "9">]>' + xmp(DJI, AbsoluteAltitude="412.5")
    assert fix(packet).altitude_m is None


def test_a_camera_without_a_fix_has_no_position():
    zero = {1: ascii_("N"), 2: rationals(*[(0, 1)] * 3), 3: ascii_("E"), 4: rationals(*[(0, 1)] * 3)}
    facts = facts_of_exif(with_gps(zero, "<"))
    assert facts.place_deg is None
    found = positions_of(["a.jpg", "b.jpg"], [facts, ExifFacts(fix=GpsFix(47.0, 8.0, 400.0))])
    assert found.names == ["b.jpg"]
    assert found.notes == ("GPS at 0,0 is no position: a.jpg",)


def test_altitudes_of_two_datums_are_reported():
    stated = {"EXIF": 283.8, "AltitudeAMSL": 315.7}
    found = positions_of(["a.jpg"], [ExifFacts(fix=GpsFix(41.0, -83.0, 283.8, altitudes_m=stated))])
    assert "altitudes are of two datums: AltitudeAMSL is +31.9 m from EXIF's" in found.notes[0]


def levels(altitudes, heights, sigma_up=5.0):
    """Altitudes and their standard deviations of photos with heights above the take-off."""
    facts = [
        ExifFacts(fix=GpsFix(47.0, 8.0, each, (3.0, 3.0, sigma_up), height_m=height))
        for each, height in zip(altitudes, heights, strict=True)
    ]
    return positions_of([f"{k}.jpg" for k in range(len(facts))], facts)


def test_heights_above_the_take_off_replace_altitudes_that_are_worse():
    heights = [60.0, 61.0, 62.5, 64.0, 60.5]
    found = levels([412.0, 409.5, 415.0, 413.0, 411.0], heights)
    assert np.diff(found.geodetic[:, 2]) == pytest.approx(np.diff(heights))
    apart = np.array([352.0, 348.5, 352.5, 349.0, 350.5])  # altitude less height
    assert found.geodetic[:, 2] - heights == pytest.approx(np.median(apart))
    assert found.sigma_m[:, 2] == pytest.approx(1.4826 * 1.5)  # the scatter of these, which has the errors of both
    assert found.common_up_m == 5.0
    assert "height above take-off" in found.sigma_from
    np.testing.assert_array_equal(found.sigma_m[:, :2], 3.0)


def test_a_barometer_is_taken_to_be_good_to_a_metre():
    found = levels([410.0, 412.0, 415.0], [60.0, 62.0, 65.0])  # DJI: altitudes are the heights and a constant
    assert found.sigma_m[:, 2].tolist() == [1.0, 1.0, 1.0]
    assert found.geodetic[:, 2].tolist() == [410.0, 412.0, 415.0]


@pytest.mark.parametrize(
    ("altitudes", "heights", "sigma_up", "kept"),
    [
        ([410.0, 412.0, 415.0], [60.0, 62.0, 65.0], 0.05, [0, 1, 2]),  # RTK
        ([410.0, 412.0, 415.0], [60.0, None, 65.0], 5.0, [1]),
        ([410.0, 412.0, 415.0, 430.0], [60.0, 62.0, 65.0, 60.0], 5.0, [3]),  # another take-off, 20 m higher
    ],
)
def test_altitudes_that_are_better_or_of_another_take_off_stay(altitudes, heights, sigma_up, kept):
    found = levels(altitudes, heights, sigma_up)
    assert found.geodetic[kept, 2].tolist() == [altitudes[k] for k in kept]
    assert found.sigma_m[kept, 2].tolist() == [sigma_up] * len(kept)


# ---------------------------------------------------------------- frames


def test_geodesy_is_that_of_proj(rng):
    geodetic = np.column_stack([rng.uniform(-89, 89, 50), rng.uniform(-180, 180, 50), rng.uniform(-400, 9000, 50)])
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = np.stack(ecef.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]), axis=1)
    assert ecef_from_geodetic(geodetic) == pytest.approx(expected, abs=1e-6)
    enu = rng.normal(size=(20, 3)) * [500, 500, 50]
    assert enu_from_geodetic(geodetic_of(enu), ORIGIN) == pytest.approx(enu, abs=1e-6)


def test_the_matrix_of_a_frame_leads_to_its_target():
    geodetic = geodetic_of([(10, 20, 30), (-50, 40, 5), (0, 0, 0)])
    local, utm = frame_at("local", geodetic), frame_at("EPSG:32632", geodetic)
    for frame, target in ((local, ecef_from_geodetic(geodetic)), (utm, None)):
        if target is None:
            to = pyproj.Transformer.from_crs(4326, 32632, always_xy=True)
            target = np.stack([*to.transform(geodetic[:, 1], geodetic[:, 0]), geodetic[:, 2]], axis=1)
        places = frame.of_geodetic(geodetic)
        assert places @ frame.matrix[:3, :3].T + frame.matrix[:3, 3] == pytest.approx(target, abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "says"),
    [
        ("EPSG:4326", "is a geographic 2D CRS; expected a projected one in metres"),
        ("EPSG:4978", "expected a projected one"),
        ("EPSG:2263", "is in US survey foot; expected one in metres"),
        ("EPSG:5555", "compound"),
        ("EPSG:1", "no such CRS"),
        ("mars", "no such CRS"),
    ],
)
def test_a_crs_that_is_not_of_metres_is_refused(crs, says):
    with pytest.raises(InputError, match=says) as error:
        check_crs(crs)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("crs", "stretch"), [("EPSG:3857", "1.47"), ("EPSG:3395", "1.46"), ("EPSG:32638", "1.1")])
def test_a_projection_that_stretches_the_ground_is_refused(crs, stretch):
    """Web and world Mercator at 47 degrees, and the UTM zone of a place 35 degrees away."""
    says = f"--crs {crs}: a metre on the ground is up to {stretch} of its metres there"
    with pytest.raises(InputError, match=says):
        frame_at(crs, geodetic_of([(0, 0, 0), (50, 0, 0)]))
    there = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(8.0, 47.0)
    with pytest.raises(InputError, match=says):
        frame_of_control(crs, np.array([[*there, 400.0]]))


def test_a_projection_whose_axes_are_mirrored_is_refused():
    with pytest.raises(InputError, match="EPSG:5513 has axes that are not east and north"):
        frame_at("EPSG:5513", np.array([[50.0, 15.0, 300.0]]))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32631", "EPSG:3035", "EPSG:2048"])
def test_velocities_and_rotations_are_rotated_to_the_north_of_the_grid(crs):
    """By where the projection puts a step of that velocity; EPSG:2048 counts to the west and to the south."""
    origin = (-33.0, 19.5, 400.0) if crs == "EPSG:2048" else (47.0, 8.0, 400.0)
    R_cw, velocity = Rotation.from_rotvec([0.3, 2.0, -1.0]).as_matrix(), np.array([7.0, -4.0, 0.5])
    fact = ExifFacts(fix=GpsFix(*origin, velocity_m_s=tuple(velocity), R_cw=tuple(map(tuple, R_cw.tolist()))))
    frame = frame_at(crs, np.array([origin]))
    turned = frame.rotated(positions_of(["a.jpg"], [fact]))
    begin, end = frame.of_geodetic(geodetic_of(np.stack([0 * velocity, velocity]), origin))
    np.testing.assert_allclose(turned.velocity_m_s[0], end - begin, rtol=4e-3)  # a projection's metres
    np.testing.assert_allclose(turned.R_cw[0] @ turned.velocity_m_s[0], R_cw @ velocity, atol=1e-12)
    stated = pyproj.Proj(crs).get_factors(origin[1], origin[0]).meridian_convergence
    # EPSG:3035 keeps areas, not angles: its east and north are rotated by 0.1 degrees more and less
    stated += 180.0 * (crs == "EPSG:2048")
    assert np.degrees(frame.convergence_rad) == pytest.approx(stated, abs=0.1 if crs == "EPSG:3035" else 1e-3)


def test_a_datum_that_gps_reaches_to_metres_only_is_reported():
    assert frame_at("EPSG:3003", np.array([[42.0, 9.0, 100.0]])).note.startswith("GPS is put into EPSG:3003 to 4 m")
    assert frame_at("EPSG:32632", np.array([[42.0, 9.0, 100.0]])).note == ""


def test_a_projection_needs_its_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    check_crs("local")
    with pytest.raises(InputError, match=r"rsundistort\[survey\]"):
        check_crs("EPSG:32632")


# ---------------------------------------------------------------- similarities


def test_a_similarity_is_known_as_well_as_it_says_and_names_what_is_off(rng):
    true = Similarity(20.0, np.linalg.qr(rng.normal(size=(3, 3)))[0], np.array([5.0, -3.0, 70.0]))
    true = Similarity(20.0, true.R * np.sign(np.linalg.det(true.R)), true.shift)
    x, sigma = rng.normal(size=(12, 3)) * [3, 2, 0.5], np.tile([1.0, 1.0, 2.0], (12, 1))
    errors = []
    for _ in range(25):
        y = true.of(x) + rng.normal(size=x.shape) * sigma
        y[4] += [60.0, 0.0, 0.0]
        found = fit_similarity(x, y, sigma)
        assert np.flatnonzero(found.deviations > 4).tolist() == [4]
        moved = found.similarity.R @ true.R.T
        turn = np.array([moved[2, 1] - moved[1, 2], moved[0, 2] - moved[2, 0], moved[1, 0] - moved[0, 1]]) / 2
        errors.append([*turn / found.sigma_rad, (found.similarity.scale / 20 - 1) / found.sigma_scale])
    # of 25 draws a standard deviation is known to 14 %; the fit, robust and of few points, to another fifth
    assert np.all((np.std(errors, axis=0) > 0.6) & (np.std(errors, axis=0) < 1.5))


def test_places_on_a_line_tell_no_roll():
    x = np.outer(np.linspace(0, 1, 8), [1.0, 0.0, 0.0])
    found = fit_similarity(x, 30 * x + 2, np.ones((8, 3)))
    assert found.sigma_rad[0] == np.inf
    assert np.isfinite(found.sigma_rad[1:]).all()
    assert found.similarity.scale == pytest.approx(30)


def test_a_known_rotation_tells_the_roll_of_places_on_a_line(rng):
    R = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    x = np.outer(np.linspace(0, 1, 8), [1.0, 0.0, 0.0]) + 1e-3 * rng.normal(size=(8, 3))
    y = 300 * x @ R.T + 2 + 0.5 * rng.normal(size=(8, 3))
    stated = Rotation.from_rotvec([0.03, -0.05, 0.04]).as_matrix() @ R, 0.08
    found = fit_similarity(x, y, np.full((8, 3), 0.5), stated)
    apart = Rotation.from_matrix(found.similarity.R @ R.T).as_rotvec()
    along = R[:, 0]
    assert abs(apart @ along) < 0.1
    assert np.linalg.norm(apart - (apart @ along) * along) < 0.01  # what the places determine is theirs
    assert (found.sigma_rad < 0.1).all()


# ---------------------------------------------------------------- tables of control points

HEADER = "name,photo,x,y,E,N,U,sigma,use\n"
GOOD = "A,1.jpg,10,20,100,200,30,0.02,\nA,2.jpg,11,21,,,,,\n"
GOOD += "B,1.jpg,5,6,101,200,30,0.05,check\nB,2.jpg,5,7,101,200,30,0.05,check\n"


def test_control_points_are_read(tmp_path):
    (tmp_path / "gcp.csv").write_text(HEADER + GOOD)
    first, second = read_control_points(tmp_path / "gcp.csv")
    assert (first.name, first.place_m, first.sigma_m) == ("A", (100.0, 200.0, 30.0), (0.02, 0.02, 0.02))
    assert first.seen == {"1.jpg": (10.0, 20.0), "2.jpg": (11.0, 21.0)}
    assert (first.is_check, second.is_check) == (False, True)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEADER, "holds no control points"),
        ("name,photo,x,y\n", "has no column 'E'"),
        (HEADER + "A,1.jpg,ten,20,1,2,3,0.1,\n", "line 2: x='ten', expected a number"),
        (HEADER + "A,1.jpg,1,nan,1,2,3,0.1,\n", "line 2: y='nan', expected a number"),
        (HEADER + "A,1.jpg,1,2,1,2,3,,\nA,2.jpg,1,2,,,,,\n", "point A: sigma='', expected a number"),
        (HEADER + "A,1.jpg,1,2,1,2,3,0,\nA,2.jpg,1,2,,,,,\n", "expected metres above 0"),
        (HEADER + "A,1.jpg,1,2,1,2,3,0.1,\n", "is seen in 1 photo; two are needed"),
        (HEADER + "A,1.jpg,1,2,1,2,3,0.1,\nA,1.jpg,1,2,1,2,3,0.1,\n", "line 3: A is in 1.jpg twice"),
        (HEADER + "A,1.jpg,1,2,1,2,3,0.1,\nA,2.jpg,1,2,1,2,9,0.1,\n", "line 3: A is given another place"),
        (HEADER + "A,1.jpg,1,2,1,2,3,0.1,no\nA,2.jpg,1,2,,,,,\n", "use='no', expected control or check"),
        (HEADER + ",1.jpg,1,2,1,2,3,0.1,\n", "line 2: expected the name of a point"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path, text, says):
    (tmp_path / "gcp.csv").write_text(text)
    with pytest.raises(FormatError, match=says):
        read_control_points(tmp_path / "gcp.csv")
