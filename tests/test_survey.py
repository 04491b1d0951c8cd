"""Reconstructions on the map: by GPS, by control points, and what does not put them there."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pyproj
import pytest
from bundle_scenes import make_scene
from click.testing import CliRunner
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation
from solved_scene import SCENES
from surveys import READOUT_S, Flight, geodetic_of, with_readout

from rsundistort import BundleOptions, KnownLength, RectifyOptions, SolveOptions, bundle_adjust
from rsundistort.bundle import KnownPlaces
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import InputError, RsUndistortWarning
from rsundistort.io import ExifFacts, GpsFix, read_solution, write_solution
from rsundistort.model import ControlPoint
from rsundistort.model.projection import project_points
from rsundistort.report.facts import map_facts, map_rows
from rsundistort.solve.outcome import solution_of
from rsundistort.solve.survey import survey_of

UTM = pyproj.Transformer.from_crs(4326, 32632, always_xy=True)


def to_utm(enu):
    latitude, longitude, height = geodetic_of([enu])[0]
    return [*UTM.transform(longitude, latitude), height]


@pytest.fixture(scope="module")
def by_gps():
    """A flight with GPS, one photo of it 60 m off, without control points."""
    flight = Flight()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solved = flight.solved(flight.facts(off=[3]))
    return flight, solved, [str(each.message) for each in said]


def test_by_gps_the_model_is_in_metres_east_north_and_up(by_gps):
    flight, solved, said = by_gps
    stated, rec = solved.georeference, solved.shared
    assert stated["crs"] == "local"
    error = rec.center_w - solved.survey.frame.of_geodetic(geodetic_of(flight.center_w))
    sigma = np.array(stated["sigma"]["place_m"])
    assert np.all(np.abs(np.delete(error, 3, axis=0).mean(0)) < 3 * sigma)
    assert np.linalg.norm(error, axis=1).max() < 1.5
    assert stated["gps"]["outliers"] == ["0003.jpg"]
    assert any("GPS that is far off, and rejected: 0003.jpg (59" in text for text in said)
    # errors of GPS as they were drawn, 0.5, 0.5 and 1 m, by nine photos less seven unknowns
    assert np.all(np.array(stated["gps"]["rms_axes_m"]) < [1.2, 1.2, 2.4])


def leveled(seed, with_heights=True):
    """Survey, model and true centres of a flight whose altitudes are 4 m too high, and known to 5 m."""
    flight = Flight(seed=seed)
    facts, rng = flight.facts(sigma_m=(0.5, 0.5, 0.7), stated=(0.5, 0.5, 5.0)), np.random.default_rng(seed)
    fixes = [replace(each.fix, altitude_m=each.fix.altitude_m + 4.0) for each in facts]
    if with_heights:
        heights = (flight.center_w[:, 2] - 3.0 + rng.normal(0, 0.5, len(fixes))).tolist()
        fixes = [replace(fix, height_m=height) for fix, height in zip(fixes, heights, strict=True)]
    facts = [ExifFacts(fix=fix) for fix in fixes]
    survey, rec = survey_of(None, [], flight.names, facts, [(768, 512)] * 10).placed(flight.start)
    true = None if survey is None else survey.frame.of_geodetic(geodetic_of(flight.center_w))
    return survey, rec, true


def test_heights_above_the_take_off_level_a_small_block():
    plain, better = (leveled(0, each)[0].fit.sigma_rad[:2].max() for each in (False, True))
    assert better < 0.5 * plain
    tilts, heights = [], []
    for seed in range(20):
        survey, rec, true = leveled(seed)
        turned, _ = Rotation.align_vectors(rec.center_w - rec.center_w.mean(0), true - true.mean(0))
        tilts.append(turned.as_rotvec()[:2] / survey.fit.sigma_rad[:2])
        heights.append((rec.center_w - true).mean(0)[2] / survey.fit.sigma_m[2])
    # the standard deviations hold, and that of the height contains the 4 m that the altitudes share
    assert 0.1 < np.mean(np.square(tilts)) < 1.6
    assert 0.5 < np.abs(heights).max() < 1.2


def test_the_place_on_the_map_is_kept_in_the_solution(by_gps, tmp_path):
    solution = solution_of(with_readout(by_gps[1], READOUT_S), SolveOptions(), RectifyOptions())
    write_solution(tmp_path / "solution.json", solution)
    again = read_solution(tmp_path / "solution.json")
    assert json.loads((tmp_path / "solution.json").read_text())["version"] == 1
    assert again.georeference["crs"] == "local"
    assert again.georeference["speeds"]["0001.jpg"]["gps_m_s"] is None
    matrix = np.array(again.georeference["transformation"])
    assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_people_are_reported_the_map(by_gps):
    facts = dict(map_facts(by_gps[1].georeference))
    assert facts["map"].startswith("east, north, up in metres at 47.0000")
    assert "rejected: 0003.jpg" in facts["GPS"]
    assert map_rows(by_gps[1].georeference)["gps"][0]["name"] == "0003.jpg"
    assert map_facts(None) == []


def test_control_points_and_gps_in_a_projection():
    flight = Flight(seed=1)
    facts = flight.facts(speed_sigma=0.2)
    # a receiver that is off by as much in all photos
    facts = [replace(each, fix=replace(each.fix, altitude_m=each.fix.altitude_m + 12.0)) for each in facts]
    solved = flight.solved(facts, "EPSG:32632", flight.control(of_place=to_utm))
    stated = solved.georeference
    assert stated["gps"]["offset_m"][2] == pytest.approx(-12.0, abs=1.5)
    checks = [each for each in stated["control"].values() if each["use"] == "check"]
    assert len(checks) == 6
    deviations = np.array([np.divide(each["residual_m"], each["sigma_m"]) for each in checks])
    # of 18 standard normals one is beyond 2; the poses' own errors, which sigma does not have, add to them
    assert (np.abs(deviations) < 2).mean() > 0.75
    assert np.abs(deviations).max() < 4
    origin, place = np.array(stated["origin"]), np.array(to_utm(flight.points_w[flight.marked[0]]))
    held = {each.name: each.place_m for each in solved.survey.control}
    assert held["P0"] == pytest.approx(tuple(place - origin), abs=0.1)
    speeds = solution_of(with_readout(solved, READOUT_S), SolveOptions(), RectifyOptions()).georeference["speeds"]
    true = np.linalg.norm(flight.velocity, axis=1) * 512 / 640 / READOUT_S
    assert [each["speed_m_s"] for each in speeds.values()] == pytest.approx(true.tolist(), rel=0.07)


def test_control_points_alone_make_the_frame():
    flight = Flight(seed=2)
    solved = flight.solved(None, None, flight.control(num_control=12))
    assert solved.georeference["crs"] == "control"
    assert "gps" not in solved.georeference
    held = np.array([each["residual_m"] for each in solved.georeference["control"].values()])
    assert np.sqrt((held**2).mean(0)) == pytest.approx(np.zeros(3), abs=0.2)
    assert np.linalg.norm(solved.shared.center_w - flight.center_w, axis=1).max() < 1.0


@pytest.mark.parametrize("places", [[(-8, 0, 1), (0, 0, 1), (8, 0, 1)], [(-8, 0, 1), (8, 0, 1)]], ids=["line", "two"])
def test_control_points_that_do_not_determine_the_frame_move_it(places):
    flight = Flight(seed=3)
    rec = flight.unmoved
    facts = flight.facts()
    # a datum that is off by 30 m
    facts = [replace(each, fix=replace(each.fix, altitude_m=each.fix.altitude_m + 30.0)) for each in facts]
    middle, control = np.median(flight.points_w, axis=0) * [1, 1, 0], []
    for k, each in enumerate(places):
        place = middle + each
        in_cameras = np.einsum("mij,mj->mi", rec.R_cw, place - rec.center_w)
        xy, seen = project_points(in_cameras, rec.camera(0), None, "global")
        seen &= ((xy >= 0) & (xy <= [767, 511])).all(1)
        shown = {flight.names[i]: tuple(xy[i].tolist()) for i in np.flatnonzero(seen)}
        utm = tuple(map(float, to_utm(place)))
        control.append(ControlPoint(f"P{k}", utm, (0.02,) * 3, shown))
    survey, by_gps = survey_of("EPSG:32632", control, flight.names, facts, [(768, 512)] * 10).placed(rec)
    survey, placed = survey.controlled(by_gps, 0.3)
    assert (placed.center_w[:10] - by_gps.center_w)[:, 2].mean() == pytest.approx(-30.0, abs=2.0)
    assert survey.gps_offset_m[2] == pytest.approx(-30.0, abs=2.0)
    assert any("control points only move the model" in each for each in survey.notes)


def test_no_crs_keeps_a_frame_of_its_own():
    assert survey_of("none", [], NAMES, FACTS, SIZES) is None


def test_lengths_that_contradict_the_map_are_reported():
    flight = Flight()
    obs, true = flight.start.observations, flight.start.points_w
    pairs = [(5, 300), (50, 400)]
    first = [np.flatnonzero(obs.point_idx == k)[0] for pair in pairs for k in pair]
    end = [(flight.names[obs.frame_idx[k]], *map(float, obs.xy_raw[k])) for k in first]
    # in the frame of the start a unit is a mean step; 0.3 of a metre is a foot
    unit = float(np.linalg.norm(np.diff(flight.center_w, axis=0), axis=1).mean()) / 0.3048
    length = [unit * float(np.linalg.norm(true[a] - true[b])) for a, b in pairs]
    lengths = [KnownLength(end[2 * k], end[2 * k + 1], each, 0.002 * each) for k, each in enumerate(length)]
    with pytest.warns(RsUndistortWarning, match="known lengths are 0.3"):
        flight.solved(flight.facts(sigma_m=(0.1, 0.1, 0.1)), lengths=lengths, shutter_model="rotation")


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_gps_that_does_not_fit_leaves_a_frame_of_its_own(spread):
    flight = Flight()
    # all at one place, and a phone's walk around a statue
    places = geodetic_of(np.random.default_rng(0).normal(size=(10, 3)) * spread)
    facts = [ExifFacts(fix=GpsFix(*each)) for each in places.tolist()]
    with pytest.warns(RsUndistortWarning, match=r"not on the map: GPS along a line, or within its own errors"):
        survey, rec = survey_of(None, [], flight.names, facts, [(768, 512)] * 10).placed(flight.start)
    assert survey is None
    assert rec is flight.start


@pytest.mark.parametrize("with_gimbal", [False, True])
def test_one_strip_is_put_on_the_map_by_its_gimbal(with_gimbal):
    flight = Flight()
    strip = flight.start.take_photos(np.arange(10) < 5)
    facts = flight.facts(sigma_m=(1.0, 1.0, 1.0))[:5]
    if with_gimbal:
        truth = np.load(SCENES / "flyover" / "tracks.npz")["R_cw"][:5]
        noise = Rotation.from_rotvec(np.deg2rad(flight.rng.normal(0, 2.0, (5, 3)))).as_matrix()
        facts = [
            replace(each, fix=replace(each.fix, R_cw=tuple(R_cw)))
            for each, R_cw in zip(facts, (noise @ truth).tolist(), strict=True)
        ]
    survey = survey_of("local", [], strip.image_names, facts, [(768, 512)] * 5)
    if not with_gimbal:
        with pytest.warns(RsUndistortWarning, match=r"not on the map: GPS along a line"):
            assert survey.placed(strip)[0] is None
        return
    placed, rec = survey.placed(strip)
    assert (placed.fit.sigma_rad < np.deg2rad(8.0)).all()
    apart = Rotation.from_matrix(rec.R_cw @ truth.transpose(0, 2, 1)).magnitude()
    assert apart.max() < np.deg2rad(8.0)


def test_a_compass_that_errs_does_not_rotate_what_gps_tells():
    flight = Flight()
    facts = flight.facts(sigma_m=(0.5, 0.5, 1.0))
    east_of_north = Rotation.from_euler("Z", -40.0, degrees=True).as_matrix() * [[1], [-1], [-1]]
    wrong = [replace(each, fix=replace(each.fix, R_cw=tuple(east_of_north.tolist()))) for each in facts]
    with_it, without = (
        survey_of("local", [], flight.names, each, [(768, 512)] * 10).placed(flight.start)[1] for each in (wrong, facts)
    )
    np.testing.assert_array_equal(with_it.R_cw, without.R_cw)


# ---------------------------------------------------------------- refusals

FACTS = [ExifFacts(fix=GpsFix(47.0, 8.0 + 1e-3 * k, 400.0)) for k in range(4)]
NAMES, SIZES = [f"{k}.jpg" for k in range(4)], [(100, 80)] * 4


def point(place=(0.0, 0.0, 0.0), xy=(10.0, 10.0), photo="1.jpg", name="A"):
    return ControlPoint(name, place, (0.1, 0.1, 0.1), {"0.jpg": (5.0, 5.0), photo: xy})


@pytest.mark.parametrize(
    ("crs", "control", "facts", "says"),
    [
        ("local", [], [ExifFacts()] * 4, "0 of 4 photos have a GPS position; the map needs three"),
        ("EPSG:32632", [], [FACTS[0], *[ExifFacts()] * 3], r"1 of 4 photos have a GPS position.*\(--gcp\)"),
        ("none", [point()], FACTS, "--crs none keeps it off"),
        (None, [point()], FACTS, "1 control points; three are needed"),
        ("EPSG:32632", [point(photo="x.jpg")], FACTS, "'x.jpg' is not among the photos"),
        ("EPSG:32632", [point(xy=(100.0, 3.0))], FACTS, r"\(100, 3\) is outside 1.jpg, 100 x 80"),
        ("EPSG:32632", [point()], FACTS, "lies far from the photos' GPS"),
    ],
)
def test_what_cannot_be_put_on_the_map_is_refused(crs, control, facts, says):
    with pytest.raises(InputError, match=says):
        survey_of(crs, control, NAMES, facts, SIZES)


def test_one_photo_with_gps_is_reported():
    with pytest.warns(RsUndistortWarning, match="not on the map: 1 of 4 photos have a GPS position"):
        assert survey_of(None, [], NAMES, [FACTS[0], *[ExifFacts()] * 3], SIZES) is None


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--crs", "EPSG:4326"], "is a geographic 2D CRS"),
        (["--gcp", "bad.csv"], "has no column 'photo'"),
    ],
)
def test_commands_refuse_in_one_line_and_write_nothing(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "bad.csv").write_text("name,x\n")
    result = CliRunner().invoke(cli, ["run", "photos", "-o", "out", *arguments])
    assert result.exit_code == 1
    assert says in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- in the adjustment


def places_of(truth, rng, sigma):
    noise = rng.normal(0, sigma, truth.center_w.shape)
    return {name: (truth.center_w[i] + noise[i], (sigma,) * 3) for i, name in enumerate(truth.image_names)}


def control_of(truth, k):
    obs = truth.observations
    rows = np.flatnonzero(obs.point_idx == k)[:2]
    seen = {truth.image_names[obs.frame_idx[i]]: tuple(obs.xy_raw[i]) for i in rows}
    return ControlPoint(str(k), tuple(truth.points_w[k] + 0.01), (0.02, 0.02, 0.05), seen)


def test_the_gradient_with_known_places_is_that_of_the_cost(rng):
    truth = make_scene(rng, "constant-motion", noise_px=0.3)
    known = KnownPlaces(
        places_of(truth, rng, 0.05), [control_of(truth, k) for k in (3, 7)], {"1.jpg": ([0.1] * 3, [0.02] * 3)}
    )
    problem = BundleProblem(
        truth, "constant-motion", BundleOptions(places=known, sigma_px=1.0), 1.0, PriorSigmas(0.05, 0.1)
    )
    state = problem.initial_state()
    equations = problem.linearize(state)
    assert problem._free.all()
    step, _ = equations.solve(1e-3)
    ahead, back = (problem.cost(problem.retract(state, tuple(h * part for part in step))) for h in (1e-4, -1e-4))
    slope = float((equations._g_frame * step[0]).sum() + (equations._g_point * step[1]).sum())
    assert (ahead - back) / 2e-4 == pytest.approx(slope, rel=1e-5)


def test_places_hold_the_frame_and_the_shape_that_measurements_leave_open(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5, num_points=40)
    options = BundleOptions(places=KnownPlaces(places_of(truth, rng, 1e-3)), sigma_px=0.5)
    found = bundle_adjust(truth, "rotation", options)
    free = bundle_adjust(truth, "rotation", replace(options, places=None))
    assert np.abs(found.reconstruction.center_w - truth.center_w).max() < 4e-3
    assert np.abs(free.reconstruction.center_w - truth.center_w).max() > 4e-3
    assert np.isfinite(found.covariances).all()
    assert found.inflation >= 1
    sigma = np.sqrt(np.einsum("maa->ma", found.covariances)[:, 3:6])
    assert np.all((sigma > 1e-4) & (sigma < 1.5e-3))


@pytest.mark.parametrize("bad", [([0, 0], [1, 1, 1]), ([0, 0, np.nan], [1, 1, 1]), ([0, 0, 0], [1, 0, 1])])
def test_bad_places_are_refused(bad):
    with pytest.raises(InputError, match="known place or velocity of 'a'"):
        KnownPlaces({"a": bad})
