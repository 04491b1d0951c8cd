from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser
from click.testing import CliRunner
from make_photos import exif_block, save_textures
from rsundistort_cli.main import cli
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from solved_scene import SCENES, solve_scene

from rsundistort import Camera, RowMotion, RsUndistortWarning, Solution, SolvedImage, read_solution, write_solution
from rsundistort.errors import FileError, FormatError
from rsundistort.io import Metadata, write_image
from rsundistort.model import Bend
from rsundistort.report import diagnostics as diagnostics_module
from rsundistort.report import read_diagnostics, verdict_of, write_diagnostics, write_figures, write_report
from rsundistort.report.displacement import displacement_field
from rsundistort.report.pictures import PictureJob, _bytes_of_each, _small, make_pictures
from rsundistort.solve import run_outputs as outputs

SECTIONS = ["verdict", "pictures", "scene", "photos", "critical", "ladder", "residuals", "cameras", "settings"]
CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
CRITICAL = {
    "singular_values": [1.9, 1.3, 0.6, 0.4, 0.27],
    "null_vector": [1.0, 0, 0, 0, 0],
    "y_axis_spread_deg": 11.0,
    "meaning": "nothing",
    "sigma_log_k": 0.0003,
    "flagged": False,
    "remedy": "none needed",
    "anchors": {},
    "sentence": "the height of the scene is uncertain by +-0.03 % (one standard deviation)",
    "warnings": [],
    "advice": [],
}
LEVEL = {"singular_values": [1.9, 1.3, 0.6, 0.2, 0.0], "null_vector": [0, 1.0, 0, 0, 0], "y_axis_spread_deg": 0.1}


class Page(HTMLParser):
    """What a report is made of: its sections, links, scripts, and the text of each element of interest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.scripts: list[str] = []
        self.text = ""
        self._script = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        if tag == "section":
            self.sections.append(given["id"])
        if tag == "a":
            self.links.append(given.get("href", ""))
        self.fetched += [v for k, v in attrs if k in ("src", "srcset", "data") or (k == "href" and tag != "a")]
        self.fetched += [k for k, _ in attrs if k.startswith("on")]
        if tag == "script":
            self._script = True
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._script = self._script and tag != "script"

    def handle_data(self, data):
        if self._script:
            self.scripts[-1] += data
        else:
            self.text += data

    @property
    def data(self):
        return json.loads(self.scripts[0])


def page_of(out) -> Page:
    return Page((out / "report.html").read_text("utf-8"))


def hand_made(
    names=("a.png", "b.png", "c.png"), critical=None, shutter_model="rotation", shift=12.0, **more
) -> Solution:
    """A solution of small photos on an arc, said to be as good as the courtyard's."""
    images = tuple(
        SolvedImage(
            name, "1", Rotation.from_euler("yx", [0.1 * i, 0.05 * i * i]).as_matrix(), np.array([i, 0.1 * i * i, 0.0]),
            RowMotion([0.02, -0.01, 0.03]), np.full(3, 1e-4), 100, 0.2, shift / (1 + i),
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    critical = None if critical is False else CRITICAL | (critical or {})
    return Solution(shutter_model, {"1": CAMERA}, {"1": CAMERA.pinhole()}, images, critical, **more)


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory):
    """Outputs of the courtyard; not to be changed."""
    out = tmp_path_factory.mktemp("courtyard") / "out"
    return out, solve_scene("courtyard", out)


@pytest.fixture
def copied(courtyard, tmp_path):
    """Outputs of the courtyard without their report, to be changed; the photos are not found from here."""
    out = tmp_path / "moved" / "out"
    shutil.copytree(courtyard[0], out, ignore=shutil.ignore_patterns("report.html"))
    return out


def quietly(*args, **kwargs):
    """A report of which nothing is missing that anybody asked for."""
    with pytest.warns(RsUndistortWarning) as caught:
        write_report(*args, **kwargs)
    return [str(each.message) for each in caught]


# ---------------------------------------------------------------- what it holds


def test_a_run_writes_the_report_and_what_it_needs(courtyard):
    out, _ = courtyard
    page = page_of(out)
    assert page.sections == SECTIONS
    assert page.fetched == ["data:,"]  # the icon
    assert "The shape can be trusted" in page.text
    assert (out / "report.npz").stat().st_size < 500_000
    assert (out / "report.html").stat().st_size < 9_000_000


def test_table_links_to_photos_that_are_there(courtyard):
    out, solution = courtyard
    files = [unquote(link) for link in page_of(out).links if not link.startswith("#")]
    assert len(files) == 2 * len(solution.images)
    assert all((out / link).is_file() for link in files)


def test_pictures_of_both_sides_are_small_and_of_the_photos_shape(courtyard):
    out, solution = courtyard
    views = page_of(out).data["views"]
    assert [view["name"] for view in views] == [image.name for image in solution.images]
    for view in views[:3]:
        for side in ("before", "after"):
            kind, _, data = view[side].partition(",")
            assert kind == "data:image/webp;base64"
            pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
            assert pixels.shape[1] / pixels.shape[0] == pytest.approx(view["size"][0] / view["size"][1], rel=0.01)
            raw = SCENES / "courtyard" / "photos" / view["name"] if side == "before" else out / "images" / view["name"]
            whole = cv2.resize(cv2.imread(str(raw)), pixels.shape[1::-1], interpolation=cv2.INTER_AREA)
            assert cv2.PSNR(whole, pixels) > 27


def test_report_from_the_folder_alone_is_the_same(courtyard):
    out, _ = courtyard
    before = (out / "report.html").read_bytes()
    write_report(out)
    assert (out / "report.html").read_bytes() == before


def test_scene_has_a_camera_a_photo_and_the_global_shutters_beside(courtyard):
    out, solution = courtyard
    scene = page_of(out).data["scene"]

    def count(points):
        return len(base64.b64decode(points["x"])) // 4

    assert count(scene["centers"]) == count(scene["global"]["centers"]) == len(solution.images)
    assert count(scene["points"]) == len(scene["colors"]) > 500


def test_rotated_photos_are_shown_upright(tmp_path):
    out = tmp_path / "out"
    for folder in (tmp_path / "photos", out / "images"):
        save_textures(folder, ["a.jpg", "b.jpg", "c.jpg"], 320, 240)
    solution = hand_made(["a.jpg", "b.jpg", "c.jpg"])
    write_solution(out / "solution.json", solution)
    quietly(out, tmp_path / "photos")
    (upright, *_) = page_of(out).data["views"]
    for folder in (tmp_path / "photos", out / "images"):
        write_image(folder / "a.jpg", cv2.imread(str(folder / "a.jpg")), Metadata(exif_block(6).tobytes()))
    quietly(out, tmp_path / "photos")
    (turned, *_) = page_of(out).data["views"]
    assert (upright["size"], turned["size"]) == ([320, 240], [240, 320])
    # a quarter turn clockwise takes (x, y) to (239 - y, x), here in thousandths of the width
    x, y = 0.320 * np.array(upright["arrows"])[:, 0::2], 0.320 * np.array(upright["arrows"])[:, 1::2]
    expected = np.stack([(239 - y) / 0.240, x / 0.240], axis=-1).reshape(-1, 4)
    np.testing.assert_allclose(np.array(turned["arrows"]), expected, atol=0.3)  # a tenth, rounded twice


# ---------------------------------------------------------------- displacement


@pytest.mark.parametrize("readout", ["top-to-bottom", "right-to-left"])
def test_displacement_is_that_of_the_rotation(readout):
    camera = replace(CAMERA, readout=readout)
    motion = RowMotion([0.05, -0.03, 0.08])
    image = SolvedImage("a", "1", motion=motion)
    solution = Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, (image,))
    raw, still = displacement_field(solution, image)
    # the row is known from the raw pixel: turn its ray back
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


# ---------------------------------------------------------------- diagnostics


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


def test_steady_motions_have_no_section(courtyard):
    assert "motions" not in page_of(courtyard[0]).sections


def test_residuals_of_photos_are_those_of_the_solution(courtyard):
    out, solution = courtyard
    told = read_diagnostics(out / "report.npz")
    assert told.names == tuple(image.name for image in solution.images)
    np.testing.assert_allclose(told.rms_px[1], [image.rms_px for image in solution.images], rtol=1e-5)
    counts = np.array([image.num_observations for image in solution.images])
    for k, whole in ((0, solution.quality["global_rms_px"]), (1, solution.quality["rms_px"])):
        assert np.sqrt(np.average(told.rms_px[k] ** 2, weights=counts)) == pytest.approx(whole, rel=0.01)
    # 0.2 px of noise in, minus what the fit absorbs
    assert 0.15 < np.nanmean(told.row_rms_px[1]) < 0.22
    assert np.nanmean(told.row_rms_px[0]) > 5 * np.nanmean(told.row_rms_px[1])
    assert told.histogram[1].sum() == pytest.approx(2 * counts.sum(), rel=0.01)
    assert told.rgb.shape == told.points_w.shape


def test_global_result_lies_beside_the_solution(courtyard):
    out, solution = courtyard
    told = read_diagnostics(out / "report.npz")
    centers = np.array([image.center_w for image in solution.images])
    away = np.linalg.norm(told.global_center_w - centers, axis=1)
    assert 0 < away.max() < 0.2 * np.linalg.norm(np.ptp(centers, axis=0))


def test_a_similarity_is_taken_out(courtyard, rng):
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


def test_diagnostics_of_a_thousand_photos_are_small(courtyard, tmp_path, rng):
    told = read_diagnostics(courtyard[0] / "report.npz")
    many, points = 1000, 15_000
    big = replace(
        told, names=tuple(f"{i:05}.jpg" for i in range(many)), rms_px=rng.random((2, many)), depth=rng.random(many),
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
def test_other_diagnostics_are_refused(courtyard, tmp_path, change, said):
    with np.load(courtyard[0] / "report.npz") as file:
        values = dict(file)
    np.savez(tmp_path / "report.npz", **(values | change))
    with pytest.raises(FormatError, match=said):
        read_diagnostics(tmp_path / "report.npz")


def test_garbled_diagnostics_are_refused(courtyard, tmp_path):
    path = tmp_path / "report.npz"
    data = (courtyard[0] / "report.npz").read_bytes()
    for garbled in (b"", data[: len(data) // 2], b"\x93NUMPY", data.replace(b"rms_px", b"rms_py")):
        path.write_bytes(garbled)
        with pytest.raises((FormatError, FileError)):
            read_diagnostics(path)


# ---------------------------------------------------------------- pictures


def test_pictures_shrink_with_the_number_of_photos(tmp_path):
    save_textures(tmp_path, ["a.jpg"], 1600, 1200)
    sizes = {count: _bytes_of_each(count) for count in (10, 100, 1000)}
    assert sum(sizes[100] for _ in range(200)) * 4 / 3 < 9e6
    assert 2000 * sizes[1000] * 4 / 3 < 15e6
    shapes = []
    for most in sizes.values():
        data = _small(tmp_path / "a.jpg", most, 1)
        assert len(data) < 1.5 * most  # noise is the worst there is to encode
        shapes.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape)
    assert shapes == sorted(shapes, reverse=True)
    assert shapes[-1][1] > 200


def test_sixteen_bit_grey_and_unreadable_photos(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 80), 32896, np.uint16))
    (tmp_path / "b.jpg").write_bytes(b"\xff\xd8\xff no photo")
    grey, none = make_pictures([PictureJob(tmp_path / name, None) for name in ("a.png", "b.jpg")], 1)
    pixels = cv2.imdecode(np.frombuffer(grey.before, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (60, 80, 3)
    assert abs(int(pixels.mean()) - 128) <= 1
    assert none.before is None


# ---------------------------------------------------------------- escaping


def test_names_are_only_names(tmp_path):
    evil = [
        "<script>.jpg",
        '"><img src=x onerror=alert(1)>.jpg',
        "a&b'{{ 7*7 }}.jpg",
        "</script><script>alert(1)<!--.jpg",
    ]
    evil += [f"plain{i}.jpg" for i in range(2)]
    out = tmp_path / "out"
    solution = hand_made(evil, options={"camera": "</script><marquee>"}, generator={"<i>": "</style>"})
    lost = SolvedImage("<u>lost</u>.jpg", "1", reason="<script>alert(2)</script>")
    write_solution_to(out, replace(solution, images=(*solution.images, lost)))
    for name in evil:
        for folder in (tmp_path / "photos", out / "images"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            save_textures(folder / "t", ["t.jpg"], 64, 48)
            shutil.copy(folder / "t" / "t.jpg", folder / name)
    quietly(out, tmp_path / "photos")
    page = page_of(out)
    assert page.tags.count("script") == 3  # data, plotly.js, ours
    assert not {"u", "marquee"} & set(page.tags)
    assert page.fetched == ["data:,"]
    assert [view["name"] for view in page.data["views"]] == evil
    for name in (*evil, "<u>lost</u>.jpg", "<script>alert(2)</script>", "</script><marquee>", "</style>"):
        assert name in page.text
    links = [link for link in page.links if not link.startswith("#")]
    assert all((out / unquote(link)).is_file() for link in links)
    assert len(links) == 2 * len(evil)


def write_solution_to(out, solution) -> None:
    out.mkdir(parents=True, exist_ok=True)
    write_solution(out / "solution.json", solution)


# ---------------------------------------------------------------- what is missing


def test_moved_photos_are_said_and_given_anew(copied):
    assert "original photos are not at hand" in quietly(copied)[0]
    page = page_of(copied)
    assert "original photos are not at hand" in page.text
    assert all(view["before"] is None and view["after"] for view in page.data["views"])
    write_report(copied, SCENES / "courtyard" / "photos")
    assert all(view["before"] and view["after"] for view in page_of(copied).data["views"])


def test_missing_photos_are_named(copied):
    (copied / "images" / "0003.jpg").unlink()
    assert quietly(copied, SCENES / "courtyard" / "photos") == ["0003.jpg is missing in images."]
    assert page_of(copied).data["views"][3]["after"] is None


def test_no_photos_at_all(copied):
    shutil.rmtree(copied / "images")
    write_report(copied)
    page = page_of(copied)
    assert page.sections == [each for each in SECTIONS if each != "pictures"]
    assert page.data["views"] == []


@pytest.mark.parametrize("data", [None, b"garbled"])
def test_without_diagnostics_the_rest_is_shown(copied, data):
    (copied / "report.npz").unlink()
    if data is not None:
        (copied / "report.npz").write_bytes(data)
    said = quietly(copied, SCENES / "courtyard" / "photos")
    assert "residuals and the global shutter's result are not shown" in said[0]
    page = page_of(copied)
    assert page.sections == [each for each in SECTIONS if each != "residuals"]
    assert "global" not in page.data["scene"]


def test_diagnostics_of_another_solution_are_not_shown(copied):
    solution = read_solution(copied / "solution.json")
    write_solution(copied / "solution.json", replace(solution, images=solution.images[1:]))
    assert "of another solution" in quietly(copied, SCENES / "courtyard" / "photos")[0]


def test_a_newer_solution_is_shown_as_far_as_it_is_understood(copied):
    path = copied / "solution.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps(value | {"version": 3, "more": []}))
    assert "newer version" in quietly(copied, SCENES / "courtyard" / "photos")[0]
    assert "update rsundistort" in page_of(copied).text
    path.write_text(json.dumps(value | {"version": 3, "images": [1]}))
    with pytest.raises(FormatError, match=r"version 3.*update rsundistort"):
        write_report(copied)


def test_a_ground_truth_file_is_a_solution_too(tmp_path):
    shutil.copy(SCENES / "courtyard" / "ground_truth.json", tmp_path / "solution.json")
    quietly(tmp_path)
    assert page_of(tmp_path).sections[0] == "verdict"


def test_one_photo_and_none(tmp_path):
    for count in (0, 1):
        write_solution(tmp_path / "solution.json", hand_made(["a.jpg"][:count], critical=False))
        quietly(tmp_path)
        assert "verdict" in page_of(tmp_path).sections


def test_trouble_with_the_report_loses_no_run(monkeypatch, tmp_path):
    def fails(*_args, **_kwargs):
        raise OSError("no space")

    monkeypatch.setattr(outputs, "write_report", fails)
    with pytest.warns(RsUndistortWarning, match="^no report was written: no space$"):
        solution = solve_scene("colonnade", tmp_path / "out", remedy="none", shutter_model="rotation")
    assert len(list((tmp_path / "out" / "images").iterdir())) == 10
    assert read_solution(tmp_path / "out" / "solution.json").shutter_model == solution.shutter_model


# ---------------------------------------------------------------- verdict


@pytest.mark.parametrize(
    ("solution", "level", "said"),
    [
        (hand_made(), "trust", "can be trusted: the cameras were turned enough"),
        (hand_made(critical=LEVEL | {"remedy": "none"}), "doubt", "Do not trust the height of the scene: all cameras"),
        (hand_made(critical=LEVEL), "trust", "although all cameras were held level"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.002, "remedy": "anchor"}), "trust", "trusted"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.01, "remedy": "prior"}), "care", "with care"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.04, "remedy": "prior"}), "doubt", "Do not"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": None}), "doubt", "Do not trust"),
        (hand_made(critical={"sigma_log_k": 0.01}), "care", "with care"),
        (hand_made(critical=False), "care", "not examined"),
        (hand_made(shift=0.7), "still", "the shutter moved no pixel by as much as one"),
        (hand_made(shift=3.0, quality={"held_out_rms_px": {"global": 0.5, "rotation": 0.499}}), "still", "held out"),
        (hand_made(shift=3.0, quality={"held_out_rms_px": {"global": 0.5, "rotation": 0.4}}), "trust", "trusted"),
        (hand_made(shutter_model="global", shift=0.0), "still", "a global shutter explains the photos as well"),
        (hand_made(shutter_model="global", options={"shutter_model": "global"}), "care", "--model auto"),
    ],
)  # fmt: skip
def test_verdict(solution, level, said):
    verdict = verdict_of(solution)
    assert verdict.level == level
    assert said in verdict.sentences[2]
    assert verdict.sentences[0] == "All 3 photos were joined into one scene."
    assert all(sentence.endswith(".") and sentence[0].isupper() for sentence in verdict.sentences)


def test_verdict_counts_photos_and_pixels():
    solution = hand_made(quality={"rms_px": 0.21, "global_rms_px": 2.0})
    lost = SolvedImage("z.jpg", "1", reason="too dark")
    verdict = verdict_of(replace(solution, images=(*solution.images, lost)))
    assert verdict.sentences[0] == "3 of 4 photos were joined into one scene; 1 was left out."
    assert "by up to 12 px" in verdict.sentences[1]
    assert "from 2.00 px to 0.21 px" in verdict.sentences[1]


def test_verdicts_of_scenes(courtyard, tmp_path):
    assert verdict_of(courtyard[1]).level == "trust"
    level = solve_scene("colonnade", tmp_path / "level", remedy="none", report=False)
    assert verdict_of(level).headline == "Do not trust the height"
    unwarped = solve_scene("courtyard", tmp_path / "unwarped", unwarped=True, report=False)
    assert verdict_of(unwarped).headline == "No correction needed"
    assert not (tmp_path / "level" / "report.html").exists()
    write_report(tmp_path / "level")  # later


# ---------------------------------------------------------------- command


@pytest.fixture
def invoke():
    return lambda *args: CliRunner().invoke(cli, ["report", *(str(arg) for arg in args)])


def test_command_says_where_the_report_is(courtyard, invoke):
    result = invoke(courtyard[0])
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{courtyard[0] / 'report.html'}\n"
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("missing",), "missing is no folder; give the one that rsundistort run or solve wrote"),
        ((".",), "holds no solution.json"),
        ((".", "--figures", "figures"), "holds no solution.json"),
    ],
)
def test_bad_folders_are_one_line(invoke, monkeypatch, tmp_path, args, said):
    monkeypatch.chdir(tmp_path)
    result = invoke(*args)
    assert result.exit_code == 1
    assert result.stderr.startswith("error: ")
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_bad_photos_folder_keeps_the_report(courtyard, invoke, tmp_path):
    before = (courtyard[0] / "report.html").read_bytes()
    result = invoke(courtyard[0], "--photos", tmp_path / "missing")
    assert result.exit_code == 1
    assert "missing is no folder" in result.stderr
    assert (courtyard[0] / "report.html").read_bytes() == before


def test_figures_for_papers(courtyard, invoke, tmp_path):
    result = invoke(courtyard[0], "--figures", tmp_path / "figures")
    assert result.exit_code == 0, result.output
    names = [
        f"{name}.{kind}" for name in ("ladder", "displacement", "paths", "critical-motion") for kind in ("png", "pdf")
    ]
    assert sorted(path.name for path in (tmp_path / "figures").glob("[!.]*")) == sorted(names)
    for path in (tmp_path / "figures").glob("*.png"):
        pixels = cv2.imread(str(path))
        assert 0.2 < pixels.mean() / 255 < 0.999
    for path in (tmp_path / "figures").glob("*.pdf"):
        assert path.read_bytes().startswith(b"%PDF")


def test_figures_of_names_that_look_like_formulas(tmp_path):
    write_solution(tmp_path / "solution.json", hand_made(["a$_{b$.jpg", "$x$.jpg", "c.jpg"]))
    assert len(write_figures(tmp_path, tmp_path / "figures")) == 6  # no ladder was climbed


# ---------------------------------------------------------------- in a browser


needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed: no report was opened in a browser")


@needs_chromium
def test_report_in_a_browser(courtyard, tmp_path):
    out, solution = courtyard
    with Browser(tmp_path, 1400, 1000) as page:
        page.open(out / "report.html", "document.documentElement?.dataset.drawn === 'yes'")
        # the slider moves, by the mouse
        page.run("document.getElementById('stage').scrollIntoView({block: 'center', behavior: 'instant'})")
        box = page.run("JSON.parse(JSON.stringify(document.getElementById('stage').getBoundingClientRect()))")
        y = box["y"] + box["height"] / 3
        page.drag(box["x"] + box["width"] / 2, y, box["x"] + box["width"] / 4, y)
        at = float(page.run("getComputedStyle(document.getElementById('stage')).getPropertyValue('--at')").rstrip("%"))
        assert at == pytest.approx(25, abs=2)
        assert page.run("getComputedStyle(document.getElementById('veil')).clipPath").startswith("inset(")
        assert page.run("['before', 'after'].every((id) => document.getElementById(id).naturalWidth > 100)")
        assert page.run("document.getElementById('shafts').getTotalLength()") > 100
        # the table sorts, both ways
        shifts = [image.rs_shift_px for image in solution.images]
        names = "[...document.querySelectorAll('#table-photos tbody tr')].map((row) => row.cells[0].dataset.value)"
        by_shift = [solution.images[i].name for i in np.argsort(shifts)]
        for expected in (by_shift[::-1], by_shift):
            page.run("document.querySelectorAll('#table-photos th button')[1].click()")
            assert page.run(names) == expected
        page.run("document.querySelectorAll('#table-photos th button')[0].click()")
        assert page.run(names) == [image.name for image in solution.images]
        # a name in it shows the photo
        page.run("document.querySelectorAll('#table-photos a[data-photo]')[7].click()")
        assert page.run("document.getElementById('before').alt") == "0007.jpg before"
        # the 3-D view has a camera for each photo, and so has the global shutter's
        traces = "document.getElementById('plot-scene').data.filter((each) => each.name.startsWith('cameras'))"
        assert page.run(f"{traces}.map((each) => each.x.length)") == [len(solution.images)] * 2
        assert page.run(f"{traces}.map((each) => each.visible)") == [True, False]
        page.run("document.querySelector('[data-show=both]').click()")
        page.wait(f"{traces}.every((each) => each.visible)")
        assert page.run("document.querySelectorAll('#plot-scene canvas').length") > 0
        for width in (390, 1400):
            page.resize(width, 900)
            page.wait(f"document.documentElement.clientWidth === {width}")
            page.wait("document.documentElement.scrollWidth <= document.documentElement.clientWidth", 5)
            # what is wider than the window scrolls in itself, or is cut on purpose
            clipped = (
                "[...document.querySelectorAll('body *')].filter((each) =>"
                " !each.closest('.scroll, .strip, .stage, svg, .plot')"
                " && each.getBoundingClientRect().right > innerWidth + 1).map((each) => each.tagName)"
            )
            assert page.run(clipped) == []
        assert page.errors == []
        assert {url.partition(":")[0] for url in page.requests} <= {"file", "data", "blob", "about"}
        assert [url for url in page.requests if url.startswith("file:")] == [(out / "report.html").as_uri()]


@needs_chromium
def test_evil_names_run_nothing_in_a_browser(tmp_path):
    names = [
        "<img src=x onerror=document.title='evil'>.jpg",
        "</script><script>document.title='evil'</script>.jpg",
        "c.jpg",
    ]
    out = tmp_path / "out"
    write_solution_to(out, hand_made(names))
    for name in names:
        save_textures(out / "t", ["t.jpg"], 64, 48)
        (out / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(out / "t" / "t.jpg", out / "images" / name)
    quietly(out)
    with Browser(tmp_path / "profile", 390, 800, dark=True) as page:
        page.open(out / "report.html", "document.documentElement?.dataset.drawn === 'yes'")
        assert page.run("document.title").endswith("out")
        assert page.run("document.getElementById('choose').options[0].text") == names[0]
        assert page.errors == []
