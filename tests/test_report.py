from __future__ import annotations

import base64
import json
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser
from click.testing import CliRunner
from make_photos import exif_block, save_textures
from report_pages import hand_made, page_of, quietly, write_solution_to
from rsundistort_cli.main import cli
from solved_scene import SCENES, solve_scene

from rsundistort import RsUndistortWarning, SolvedImage, read_solution, write_solution
from rsundistort.errors import FormatError
from rsundistort.io import Metadata, write_image
from rsundistort.report import verdict_of, write_figures, write_report
from rsundistort.report.content import cameras
from rsundistort.report.pictures import PictureJob, _bytes_of_each, _small, make_pictures
from rsundistort.solve import run_outputs as outputs

SECTIONS = ["verdict", "pictures", "scene", "photos", "critical", "models", "residuals", "cameras", "settings"]
LEVEL = {"singular_values": [1.9, 1.3, 0.6, 0.2, 0.0], "null_vector": [0, 1.0, 0, 0, 0], "y_axis_spread_deg": 0.1}


@pytest.fixture(scope="module")
def small(solved_courtyard, tmp_path_factory):
    """The courtyard's photos, and outputs without their report, at a quarter of their size: most of a report's time."""
    folder = tmp_path_factory.mktemp("small")
    shutil.copytree(solved_courtyard[0], folder / "out", ignore=shutil.ignore_patterns("report.html"))
    shutil.copytree(SCENES / "courtyard" / "photos", folder / "photos")
    for path in (*(folder / "photos").iterdir(), *(folder / "out" / "images").iterdir()):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
    return folder


@pytest.fixture
def photos(small):
    return small / "photos"


@pytest.fixture
def copied(small, tmp_path):
    """These outputs, to be changed; the photos are not found from here."""
    return Path(shutil.copytree(small / "out", tmp_path / "moved" / "out"))


# ---------------------------------------------------------------- what it holds


def test_a_run_writes_the_report_and_what_it_needs(solved_courtyard):
    out, _ = solved_courtyard
    page = page_of(out)
    assert page.sections == SECTIONS
    assert page.fetched == ["data:,"]  # the icon
    assert "The shape can be trusted" in page.text
    assert (out / "report.npz").stat().st_size < 500_000
    assert (out / "report.html").stat().st_size < 9_000_000


def test_table_links_to_photos_that_are_there(solved_courtyard):
    out, solution = solved_courtyard
    files = [unquote(link) for link in page_of(out).links if not link.startswith("#")]
    assert len(files) == 2 * len(solution.images)
    assert all((out / link).is_file() for link in files)


def test_pictures_of_both_sides_are_small_and_of_the_photos_shape(solved_courtyard):
    out, solution = solved_courtyard
    views = page_of(out).data["views"]
    assert [view["name"] for view in views] == [image.name for image in solution.images]
    for view in views[:3]:
        for side in ("before", "after"):
            kind, _, data = view[side].partition(",")
            assert kind == "data:image/jpeg;base64"
            pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
            assert pixels.shape[1] / pixels.shape[0] == pytest.approx(view["size"][0] / view["size"][1], rel=0.01)
            raw = SCENES / "courtyard" / "photos" / view["name"] if side == "before" else out / "images" / view["name"]
            whole = cv2.resize(cv2.imread(str(raw)), pixels.shape[1::-1], interpolation=cv2.INTER_AREA)
            assert cv2.PSNR(whole, pixels) > 27


def test_report_from_the_folder_alone_is_the_same(solved_courtyard):
    out, _ = solved_courtyard
    before = (out / "report.html").read_bytes()
    write_report(out)
    assert (out / "report.html").read_bytes() == before


def test_scene_has_a_camera_a_photo_and_the_global_shutters_beside(solved_courtyard):
    out, solution = solved_courtyard
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
    # a quarter rotation clockwise takes (x, y) to (239 - y, x), here in thousandths of the width
    x, y = 0.320 * np.array(upright["arrows"])[:, 0::2], 0.320 * np.array(upright["arrows"])[:, 1::2]
    expected = np.stack([(239 - y) / 0.240, x / 0.240], axis=-1).reshape(-1, 4)
    np.testing.assert_allclose(np.array(turned["arrows"]), expected, atol=0.3)  # a tenth, rounded twice


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


# ---------------------------------------------------------------- what is missing


def test_every_camera_has_its_standard_deviations():
    one = hand_made(quality={"sigma_intrinsics": {"1": {"f": 0.5, "cx": 0.2}, "2": {"f": 3.0}}})
    other = replace(one.cameras["1"], K=one.cameras["1"].K + np.diag([9.0, 9.0, 0.0]))
    shown = cameras(replace(one, cameras={**one.cameras, "2": other}))
    assert ["0.5" in str(shown[0]["intrinsics"]), "3.0" in str(shown[1]["intrinsics"])] == [True, True]


def test_moved_photos_are_said_and_given_anew(copied, photos):
    assert "original photos are not at hand" in quietly(copied)[0]
    page = page_of(copied)
    assert "original photos are not at hand" in page.text
    assert all(view["before"] is None and view["after"] for view in page.data["views"])
    write_report(copied, photos)
    assert all(view["before"] and view["after"] for view in page_of(copied).data["views"])


def test_missing_photos_are_named(copied, photos):
    (copied / "images" / "0003.jpg").unlink()
    assert quietly(copied, photos) == ["0003.jpg is missing in images."]
    assert page_of(copied).data["views"][3]["after"] is None


def test_no_photos_at_all(copied):
    shutil.rmtree(copied / "images")
    write_report(copied)
    page = page_of(copied)
    assert page.sections == [each for each in SECTIONS if each != "pictures"]
    assert page.data["views"] == []


@pytest.mark.parametrize("data", [None, b"garbled"])
def test_without_diagnostics_the_rest_is_shown(copied, photos, data):
    (copied / "report.npz").unlink()
    if data is not None:
        (copied / "report.npz").write_bytes(data)
    said = quietly(copied, photos)
    assert "residuals and the global shutter's result are not shown" in said[0]
    page = page_of(copied)
    assert page.sections == [each for each in SECTIONS if each != "residuals"]
    assert "global" not in page.data["scene"]


def test_diagnostics_of_another_solution_are_not_shown(copied, photos):
    solution = read_solution(copied / "solution.json")
    write_solution(copied / "solution.json", replace(solution, images=solution.images[1:]))
    assert "of another solution" in quietly(copied, photos)[0]


def test_a_newer_solution_is_shown_as_far_as_it_is_understood(copied, photos):
    path = copied / "solution.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps(value | {"version": 3, "more": []}))
    assert "newer version" in quietly(copied, photos)[0]
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
        (hand_made(), "trust", "can be trusted: the cameras were rotated enough"),
        (hand_made(critical=LEVEL | {"remedy": "none"}), "doubt", "Do not trust the height of the scene: all cameras"),
        (hand_made(critical=LEVEL), "trust", "although all cameras were held level"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.002, "remedy": "anchor"}), "trust", "trusted"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.01, "remedy": "prior"}), "care", "with care"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": 0.04, "remedy": "prior"}), "doubt", "Do not"),
        (hand_made(critical=LEVEL | {"flagged": True, "sigma_log_k": None}), "doubt", "Do not trust"),
        (hand_made(critical={"sigma_log_k": 0.01}), "care", "with care"),
        (hand_made(critical=False), "care", "not examined"),
        (hand_made(shift=0.7), "still", "the shutter displaced no pixel by as much as one"),
        (hand_made(shift=3.0, quality={"held_out_rms_px": {"global": 0.5, "rotation": 0.499}}), "still", "held-out"),
        (hand_made(shift=3.0, quality={"held_out_rms_px": {"global": 0.5, "rotation": 0.4}}), "trust", "trusted"),
        (hand_made(shutter_model="global", shift=0.0), "still", "a global shutter explains the photos as well"),
        (hand_made(shutter_model="global", options={"shutter_model": "global"}), "care", "--model auto"),
    ],
)  # fmt: skip
def test_verdict(solution, level, said):
    verdict = verdict_of(solution)
    assert verdict.level == level
    assert said in verdict.sentences[2]
    assert verdict.sentences[0] == "All 3 photos were registered in one scene."
    assert all(sentence.endswith(".") and sentence[0].isupper() for sentence in verdict.sentences)


def test_a_video_of_a_camera_that_only_rotated_has_no_shape():
    said = {"shutter": "found", "shape": "trusted", "reasons": []}
    solution = hand_made(quality={"readout_time": {"seconds": 0.02}}, verdict=said)
    still = [replace(image, center_w=np.zeros(3)) for image in solution.images]
    verdict = verdict_of(replace(solution, images=tuple(still)))
    assert verdict.headline == "The rotations can be trusted"
    assert verdict.sentences[0] == "All 3 photos were registered by their directions."
    assert "no positions and no scene" in verdict.sentences[2]
    travelled = verdict_of(solution)
    assert travelled.headline == "The shape can be trusted"


def test_verdict_counts_photos_and_pixels():
    solution = hand_made(quality={"rms_px": 0.21, "global_rms_px": 2.0})
    lost = SolvedImage("z.jpg", "1", reason="too dark")
    verdict = verdict_of(replace(solution, images=(*solution.images, lost)))
    assert verdict.sentences[0] == "3 of 4 photos were registered in one scene; 1 was left out."
    assert "by up to 12 px" in verdict.sentences[1]
    assert "from 2.00 px to 0.21 px" in verdict.sentences[1]


@pytest.mark.slow
def test_verdicts_of_scenes(solved_courtyard, tmp_path):
    assert verdict_of(solved_courtyard[1]).level == "trust"
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


def test_command_says_where_the_report_is(solved_courtyard, invoke):
    result = invoke(solved_courtyard[0])
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{solved_courtyard[0] / 'report.html'}\n"
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


def test_bad_photos_folder_keeps_the_report(solved_courtyard, invoke, tmp_path):
    before = (solved_courtyard[0] / "report.html").read_bytes()
    result = invoke(solved_courtyard[0], "--photos", tmp_path / "missing")
    assert result.exit_code == 1
    assert "missing is no folder" in result.stderr
    assert (solved_courtyard[0] / "report.html").read_bytes() == before


@pytest.mark.slow
def test_figures_for_papers(solved_courtyard, invoke, tmp_path):
    result = invoke(solved_courtyard[0], "--figures", tmp_path / "figures")
    assert result.exit_code == 0, result.output
    names = [
        f"{name}.{kind}" for name in ("models", "displacement", "paths", "critical-motion") for kind in ("png", "pdf")
    ]
    assert sorted(path.name for path in (tmp_path / "figures").glob("[!.]*")) == sorted(names)
    for path in (tmp_path / "figures").glob("*.png"):
        pixels = cv2.imread(str(path))
        assert 0.2 < pixels.mean() / 255 < 0.999
    for path in (tmp_path / "figures").glob("*.pdf"):
        assert path.read_bytes().startswith(b"%PDF")


def test_figures_of_names_that_look_like_formulas(tmp_path):
    write_solution(tmp_path / "solution.json", hand_made(["a$_{b$.jpg", "$x$.jpg", "c.jpg"]))
    assert len(write_figures(tmp_path, tmp_path / "figures")) == 6  # no models were compared


# ---------------------------------------------------------------- in a browser


needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed: no report was opened in a browser")


@needs_chromium
def test_report_in_a_browser(solved_courtyard, tmp_path):
    out, solution = solved_courtyard
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
