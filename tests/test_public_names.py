"""What is on top of the package, where the rest is, and that former names still work."""

from __future__ import annotations

import ast
import inspect
import json
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from bundle_scenes import make_scene, perturbed

import rsundistort as rs
from rsundistort._former import FORMER_NAMES
from rsundistort.analysis import ErrorSummary, Evaluation, PhiErrorSummary, PoseAnalysis, PsnrSummary
from rsundistort.bundle import BundleResult, ReadoutChoice, bundle_adjust
from rsundistort.critical import critical_motion
from rsundistort.errors import InputError

ROOT = Path(__file__).parent.parent
ON_TOP = {
    "the job": ["run", "solve", "rectify_folder", "analyze", "evaluate"],
    "its options": ["RunOptions", "SolveOptions", "RectifyOptions", "ViewOptions", "GyroOptions", "KnownLength"],
    "a photo": ["rectify", "init_rectify_map", "RemapGrid", "optimal_new_camera", "largest_shift_px"],
    "points": ["undistort_points", "distort_points", "project_points", "unproject_points"],
    "data": ["Camera", "RowMotion", "Solution", "SolvedImage", "read_solution", "write_solution"],
    "depth": ["AtInfinity", "Plane", "DepthMap"],
    "adjustment": ["bundle_adjust", "BundleOptions", "Observations", "Reconstruction", "critical_motion"],
    "errors": ["RsUndistortError", "RsUndistortWarning"],
}
# what former names were called before they moved: their packages, and those whose place is not their name
MODULES = {"rsundistort": "", "rsundistort.pipeline": "pipeline."}
STAND_INS = {"climb", "remap_grid", "solve_model"}


def former_of(module):
    prefix = MODULES[module]
    names = [name.removeprefix(prefix) for name in FORMER_NAMES if name.startswith(prefix)]
    return [name for name in names if "." not in name]


def test_on_top_is_what_most_users_call():
    assert sorted(rs.__all__) == sorted(name for names in ON_TOP.values() for name in names)
    assert all(getattr(rs, name).__module__.startswith("rsundistort.") for name in rs.__all__)


@pytest.mark.parametrize(
    ("module", "name"), [(module, name) for module in MODULES for name in former_of(module)]
)  # fmt: skip
def test_a_former_name_gives_what_the_present_one_does_and_says_it(module, name):
    present = "rsundistort." + FORMER_NAMES[MODULES[module] + name]
    with pytest.warns(DeprecationWarning, match=re.escape(f"{module}.{name} is now {present}")) as warned:
        found = getattr(import_module(module), name)
    assert len(warned) == 1
    assert warned[0].filename == __file__
    if name not in STAND_INS:
        place, _, attribute = present.rpartition(".")
        assert found is getattr(import_module(place), attribute)
        assert attribute == name


def test_the_former_name_of_the_model_sequence_still_works():
    with pytest.warns(DeprecationWarning, match="rsundistort.bundle.LADDER is now rsundistort.bundle.MODEL_SEQUENCE"):
        assert rs.bundle.LADDER is rs.bundle.MODEL_SEQUENCE
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        rs.bundle.nothing  # noqa: B018


def test_no_former_name_is_on_top_and_unknown_ones_are_errors():
    assert not set(FORMER_NAMES) & set(rs.__all__)
    for module in map(import_module, MODULES):
        with pytest.raises(AttributeError, match=f"module '{module.__name__}' has no attribute 'nothing'"):
            module.nothing  # noqa: B018


def test_importing_a_former_name_warns_where_it_is_written(tmp_path):
    script = tmp_path / "users.py"
    script.write_text("import warnings\nfrom rsundistort import psnr\nprint(psnr.__module__)\n")
    done = subprocess.run(
        [sys.executable, "-W", "default", str(script)], capture_output=True, text=True, check=True
    )  # fmt: skip
    assert done.stdout.split() == ["rsundistort.evaluation.metrics"]
    assert f"{script}:2: DeprecationWarning: rsundistort.psnr is now rsundistort.evaluation.psnr" in done.stderr


def test_the_package_and_its_benchmarks_use_no_former_name():
    """Tests and documents run with warnings as errors; these do not run in every test."""
    former = {name for name in FORMER_NAMES if "." not in name}
    for path in [path for folder in ("rsundistort", "cli", "benchmarks") for path in ROOT.glob(f"{folder}/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "rsundistort":
                assert not former & {alias.name for alias in node.names}, path
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "rs":
                assert node.attr not in former, path


def test_simpler_first_starts_each_model_from_the_one_before_as_the_former_function_did(rng):
    truth = make_scene(rng, "rotation")
    start, costs = perturbed(truth, rng), []
    result = bundle_adjust(start, "rotation", progress=costs.append, simpler_first=True)
    # noise is taken for 0.02 px at least, so phi's deviation for 1e-4; the prior pulls by a small part of that
    np.testing.assert_allclose(result.reconstruction.phi, truth.phi, atol=1e-4)
    assert costs
    with pytest.warns(DeprecationWarning, match="simpler_first=True"):
        climb = rs.climb
    seen = []
    results = climb(start, rungs=("global", "two-step", "rotation"), progress=lambda model, cost: seen.append(model))
    assert list(results) == list(dict.fromkeys(seen)) == ["global", "two-step", "rotation"]
    np.testing.assert_array_equal(results["rotation"].reconstruction.phi, result.reconstruction.phi)
    assert all(isinstance(each, BundleResult) for each in results.values())


def test_simpler_first_refuses_an_unknown_model_before_any_work(rng):
    costs = []
    with pytest.raises(InputError, match="shutter model 'rolling'"):
        bundle_adjust(make_scene(rng, "global"), "rolling", progress=costs.append, simpler_first=True)
    assert costs == []


def test_the_former_function_makes_the_same_grid():
    camera, motion = (
        rs.Camera(64, 48, [[50, 0, 32], [0, 50, 24], [0, 0, 1]], [-0.1, 0, 0, 0]),
        rs.RowMotion([0.05, 0, 0.02]),
    )
    with pytest.warns(DeprecationWarning, match="RemapGrid.from_camera"):
        remap_grid = rs.remap_grid
    former, present = remap_grid(camera, motion), rs.RemapGrid.from_camera(camera, motion)
    np.testing.assert_array_equal(former.map_x, present.map_x)
    np.testing.assert_array_equal(former.map_y, present.map_y)


# ---------------------------------------------------------------- results that were dicts

EVALUATION = Evaluation(
    photos=3,
    registered=2,
    rotation_deg=None,
    center=ErrorSummary(0.1, 0.2, 0.3),
    phi_mrad_per_frame=PhiErrorSummary(1.0, 2.0, 3.0, (0.5, 1.0, 1.5)),
    psnr_db=PsnrSummary(40.0, 38.0, {"a.jpg": 40.0}),
)


def test_evaluations_are_written_as_before():
    assert json.dumps(EVALUATION.to_json()) == (
        '{"photos": 3, "registered": 2, "center": {"mean": 0.1, "median": 0.2, "max": 0.3}, "phi_mrad_per_frame": '
        '{"mean": 1.0, "median": 2.0, "max": 3.0, "mean_per_component": [0.5, 1.0, 1.5]}, '
        '"psnr_db": {"median": 40.0, "min": 38.0, "photos": {"a.jpg": 40.0}}}'
    )


def test_analyses_are_written_as_before():
    degeneracy = critical_motion(np.tile(np.eye(3), (3, 1, 1)), np.eye(3))
    found = PoseAnalysis(3, ("top-to-bottom",), degeneracy, advice=("Rotate one.",))
    written = json.loads(json.dumps(found.to_json()))
    assert list(written) == [
        "photos", "readout", "singular_values", "null_vector", "y_axis_spread_deg", "meaning", "critical", "sentence",
        "advice",
    ]  # fmt: skip
    assert written["readout"] == ["top-to-bottom"]
    assert written["singular_values"] == degeneracy.singular_values.tolist()
    assert written["critical"] is True
    assert written["sentence"] is None
    assert written["advice"] == ["Rotate one."]
    with pytest.warns(DeprecationWarning, match="PoseAnalysis.meter is now PoseAnalysis.degeneracy"):
        assert found.meter is degeneracy


def test_entries_of_the_former_dicts_answer_with_a_warning():
    with pytest.warns(DeprecationWarning, match=r"Evaluation is no dict: use its fields, or Evaluation.to_json\(\)"):
        assert EVALUATION["center"]["median"] == EVALUATION.center.median
    with pytest.warns(DeprecationWarning, match="Evaluation is no dict"):
        assert "rotation_deg" not in EVALUATION


def test_former_fields_answer_with_a_warning():
    with pytest.warns(DeprecationWarning, match="BundleOptions.spread_rounds is now BundleOptions.prior_sigma_rounds"):
        options = rs.BundleOptions(spread_rounds=3)
    assert options == rs.BundleOptions(prior_sigma_rounds=3)
    with pytest.warns(DeprecationWarning, match="spread_tolerance is now BundleOptions.prior_sigma_tolerance"):
        assert replace(options, spread_tolerance=0.1) == replace(options, prior_sigma_tolerance=0.1)
    with pytest.warns(DeprecationWarning, match="BundleOptions.spread_rounds is now"):
        assert options.spread_rounds == 3
    with pytest.warns(DeprecationWarning, match="SolvedImage.turned is now SolvedImage.applied_orientation"):
        image = rs.SolvedImage("a.jpg", "0", turned=6)
    assert image.applied_orientation == 6
    with pytest.warns(DeprecationWarning, match="ReadoutChoice.turned is now ReadoutChoice.changed"):
        assert ReadoutChoice(None, {0: 9.0, 1: 0.0}).turned == (0,)
    assert pickle.loads(pickle.dumps(options)) == options  # as workers get them


def test_former_fields_leave_errors_and_signatures_as_they_are():
    with pytest.raises(InputError, match="prior_sigma_tolerance=0, expected a positive number"):
        rs.BundleOptions(prior_sigma_tolerance=0)
    with pytest.raises(TypeError, match="unexpected keyword argument 'spread'"):
        rs.BundleOptions(spread=3)
    assert "prior_sigma_rounds" in inspect.signature(rs.BundleOptions).parameters
