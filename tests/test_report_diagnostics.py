"""What the report shows of displacements, residuals and tracks."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from report_pages import CAMERA, hand_made, page_of, quietly, write_solution_to
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort import RowMotion, Solution, SolvedImage
from rsundistort.errors import FileError, FormatError
from rsundistort.model import Bend
from rsundistort.report import diagnostics as diagnostics_module
from rsundistort.report import read_diagnostics, write_diagnostics
from rsundistort.report.displacement import displacement_field


@pytest.mark.parametrize("readout", ["top-to-bottom", "right-to-left"])
def test_displacement_is_that_of_the_rotation(readout):
    camera = replace(CAMERA, readout=readout)
    motion = RowMotion([0.05, -0.03, 0.08])
    image = SolvedImage("a", "1", motion=motion)
    solution = Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, (image,))
    raw, still = displacement_field(solution, image)
    # the row is known from the raw pixel: rotate its ray back
    rays = np.column_stack([(raw - [160, 120]) / 300, np.ones(len(raw))])
    clock = rays[:, 1] if readout == "top-to-bottom" else -rays[:, 0]
    back = Rotation.from_rotvec(-clock[:, None] * motion.phi).apply(rays)
    np.testing.assert_allclose(300 * back[:, :2] / back[:, 2:] + [160, 120], still, atol=1e-6)
    assert len(raw) > 60


def test_no_motion_no_displacement():
    image = SolvedImage("a", "1", motion=RowMotion())
    camera = replace(CAMERA, dist=np.array([-0.1, 0.02, 0, 0]))
    raw, still = displacement_field(Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, (image,)), image)
    np.testing.assert_allclose(raw, still, atol=1e-6)


def test_displacement_of_a_travelling_camera_depends_on_the_depth():
    image = SolvedImage("a", "1", np.eye(3), np.zeros(3), RowMotion([0, 0, 0], [0.5, 0, 0]))
    solution = Solution("constant-motion", {"1": CAMERA}, {"1": CAMERA.pinhole()}, (image,))
    far, near = (displacement_field(solution, image, depth) for depth in (None, 10.0))
    np.testing.assert_allclose(*far, atol=1e-6)
    # x' = X/z - r v / z with the row that shows it
    clock = (near[0][:, 1] - 120) / 300
    np.testing.assert_allclose(near[0][:, 0] - near[1][:, 0], -300 * clock * 0.5 / 10, atol=1e-6)


def test_motions_that_are_not_steady_are_drawn_over_the_lines(tmp_path):
    """The curve of each axis, read back from the page, is the rotation of the lines in degrees."""
    rng = np.random.default_rng(4)
    made = hand_made()
    bend = Bend(*CAMERA.clock_range, rng.normal(size=(9, 3)) * 0.01)
    images = list(made.images)
    images[1] = replace(images[1], name="b & <b>.png", motion=replace(images[1].motion, bend=bend))
    write_solution_to(tmp_path, replace(made, images=tuple(images)))
    quietly(tmp_path)
    page = page_of(tmp_path)
    assert page.sections[page.sections.index("photos") + 1] == "motions"
    text = (tmp_path / "report.html").read_text("utf-8")
    section = text[text.index('<section id="motions">') : text.index('<section id="critical">')]
    assert section.count("<svg") == 1  # the others are steady
    assert "b &amp; &lt;b&gt;.png" in section
    high, low = (float(each.replace("−", "-")) for each in re.findall(r">([−0-9.]+)°</text>", section))
    curves = [np.array(re.findall(r"([0-9.]+) ([0-9.]+)", d), float) for d in re.findall(r'<path d="([^"]+)"', section)]
    clock = np.linspace(*CAMERA.clock_range, len(curves[0]))
    turn = np.degrees(clock[:, None] * images[1].motion.phi + CubicSpline(bend.clock, bend.rotation)(clock))
    for k, curve in enumerate(curves):
        np.testing.assert_allclose(curve[:, 0], np.linspace(0, 240, len(curve)), atol=0.06)
        shown = high - (curve[:, 1] - 4) / 112 * (high - low)
        np.testing.assert_allclose(shown, turn[:, k], atol=0.02)  # as the marks are rounded
    assert len(curves) == 3
    assert section.count('class="steady"') == 3


def test_steady_motions_have_no_section(solved_courtyard):
    assert "motions" not in page_of(solved_courtyard[0]).sections


def test_residuals_of_photos_are_those_of_the_solution(solved_courtyard):
    out, solution = solved_courtyard
    stated = read_diagnostics(out / "report.npz")
    assert stated.names == tuple(image.name for image in solution.images)
    np.testing.assert_allclose(stated.rms_px[1], [image.rms_px for image in solution.images], rtol=1e-5)
    counts = np.array([image.num_observations for image in solution.images])
    for k, whole in ((0, solution.quality["global_rms_px"]), (1, solution.quality["rms_px"])):
        assert np.sqrt(np.average(stated.rms_px[k] ** 2, weights=counts)) == pytest.approx(whole, rel=0.01)
    # 0.2 px of noise in, minus what the fit absorbs
    assert 0.15 < np.nanmean(stated.row_rms_px[1]) < 0.22
    assert np.nanmean(stated.row_rms_px[0]) > 5 * np.nanmean(stated.row_rms_px[1])
    assert stated.histogram[1].sum() == pytest.approx(2 * counts.sum(), rel=0.01)
    assert stated.rgb.shape == stated.points_w.shape


def test_global_result_lies_beside_the_solution(solved_courtyard):
    out, solution = solved_courtyard
    stated = read_diagnostics(out / "report.npz")
    centers = np.array([image.center_w for image in solution.images])
    away = np.linalg.norm(stated.global_center_w - centers, axis=1)
    assert 0 < away.max() < 0.2 * np.linalg.norm(np.ptp(centers, axis=0))


def test_a_similarity_is_taken_out(solved_courtyard, rng):
    from rsundistort import Observations, Reconstruction

    R = Rotation.random(5, random_state=1).as_matrix()
    none = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    rec = Reconstruction(
        [CAMERA], list("abcde"), np.zeros(5, int), R, rng.normal(size=(5, 3)), rng.normal(size=(9, 3)), none
    )
    S = Rotation.random(random_state=2).as_matrix()
    other = replace(rec, R_cw=R @ S.T, center_w=3 * rec.center_w @ S.T + 1, points_w=3 * rec.points_w @ S.T + 1)
    back = diagnostics_module._aligned(other, rec)
    for name in ("R_cw", "center_w", "points_w"):
        np.testing.assert_allclose(getattr(back, name), getattr(rec, name), atol=1e-9)


def test_diagnostics_of_a_thousand_photos_are_small(solved_courtyard, tmp_path, rng):
    stated = read_diagnostics(solved_courtyard[0] / "report.npz")
    many, points = 1000, 15_000
    big = replace(
        stated, names=tuple(f"{i:05}.jpg" for i in range(many)), rms_px=rng.random((2, many)), depth=rng.random(many),
        row_mean_px=rng.normal(size=(2, many, 12, 2)), points_w=rng.normal(size=(points, 3)),
        global_points_w=rng.normal(size=(points, 3)), point_idx=np.arange(points),
        rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8), global_R_cw=rng.normal(size=(many, 3, 3)),
        global_center_w=rng.normal(size=(many, 3)),
    )  # fmt: skip
    write_diagnostics(tmp_path / "report.npz", big)
    assert (tmp_path / "report.npz").stat().st_size < 1_000_000
    back = read_diagnostics(tmp_path / "report.npz")
    np.testing.assert_allclose(back.row_mean_px, big.row_mean_px, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": np.array(2)}, "version 2"),
        ({"format": np.array("x")}, "format"),
        ({"depth": np.zeros(3)}, "depth"),
        ({"names": np.array([{}], dtype=object)}, "garbled"),
    ],
)
def test_other_diagnostics_are_refused(solved_courtyard, tmp_path, change, said):
    with np.load(solved_courtyard[0] / "report.npz") as file:
        values = dict(file)
    np.savez(tmp_path / "report.npz", **(values | change))
    with pytest.raises(FormatError, match=said):
        read_diagnostics(tmp_path / "report.npz")


def test_garbled_diagnostics_are_refused(solved_courtyard, tmp_path):
    path = tmp_path / "report.npz"
    data = (solved_courtyard[0] / "report.npz").read_bytes()
    for garbled in (b"", data[: len(data) // 2], b"\x93NUMPY", data.replace(b"rms_px", b"rms_py")):
        path.write_bytes(garbled)
        with pytest.raises((FormatError, FileError)):
            read_diagnostics(path)
