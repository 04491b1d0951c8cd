"""What the README and docs/ show is true: Python runs, commands are understood (slow tests run them), links lead on."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.main import cli
from survey import in_utm, with_position
from surveys import geodetic_of

import rsundistort as rs
from rsundistort import io as rs_io
from rsundistort.io import read_camera_file
from rsundistort.solve import OutputOptions

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    str(path.relative_to(ROOT)): path
    for path in [
        ROOT / "README.md",
        *sorted((ROOT / "sample_scenes").rglob("*.md")),
        *sorted((ROOT / "docs").glob("*.md")),
    ]
}
#: What a block may be: Python and commands run, JSON is read, text is not looked at (but as what Python prints); the
#: others are directives of Sphinx.
LANGUAGES = {"python", "sh", "json", "text", "{toctree}", "{public}", "{eval-rst}"}
#: Programs that are not ours and not run.
OTHERS = {"colmap", "docker", "gsplat", "ns-train", "oty", "pip", "mkdir", "cp"}
#: Commands that are understood but not run: what they need is not here.
NOT_RUN = {
    "simulate scene": "renders for a minute; tests/test_synthetic_scene.py runs it",
    "experiment two": "three runs; tests/test_experiments.py runs it",
    "solve --database": "needs COLMAP's database; tests of solve run it",
    "run --every": "frames of the video show no scene; tests/test_video.py runs it",
    "run --sharpest": "as --every",
    "run --frames": "tests/test_clip_outputs.py runs it",
    "readout": "tests/test_clip_outputs.py runs it",
    "run --gyro": "tests/test_gyro.py runs it",
    "run --export ncore": "needs an extra of 3 GB; tests/test_exports.py runs it where that is",
}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; "python gsplat" is Python that needs gsplat."""

    language: str
    needs: str
    text: str
    line: int
    follows: int | None  # the block that ends right before it, if there is nothing between


def blocks_of(page: str) -> list[Block]:
    found: list[Block] = []
    lines = PAGES[page].read_text(encoding="utf-8").splitlines()
    begun, end = None, -1
    for number, line in enumerate(lines):
        fence = re.match(r" *```(.*)$", line)
        if not fence:
            continue
        if begun is None:
            begun = number, fence[1].split()
            continue
        start, info = begun
        near = bool(found) and not any(text.strip() for text in lines[end + 1 : start])
        text = "\n".join(lines[start + 1 : number])
        language, needs = [*info, "", ""][:2]
        found.append(Block(language, needs, text, start + 1, len(found) - 1 if near else None))
        begun, end = None, number
    assert begun is None, f"{page}: the block of line {begun[0] + 1} has no end"
    return found


def with_blocks(language: str) -> list[str]:
    return [page for page in PAGES if any(block.language == language for block in blocks_of(page))]


def commands_of(page: str) -> list[str]:
    text = "\n".join(block.text for block in blocks_of(page) if block.language == "sh").replace("\\\n", " ")
    return [line for line in text.splitlines() if line.split("#")[0].strip()]


def words_of(line: str) -> list[str]:
    words = shlex.split(line, comments=True)
    return [words[0].removeprefix(".venv/bin/"), *words[1:]]


def prose_of(page: str) -> str:
    return re.sub(r"^ *```.*?^ *```$", "", PAGES[page].read_text(encoding="utf-8"), flags=re.S | re.M)


def spans_of(page: str) -> list[str]:
    return [span.replace("\\|", "|") for span in re.findall(r"`([^`\n]+)`", prose_of(page))]


def resolve(words: list[str]) -> tuple[click.Command, str, list[str]]:
    """The command that the words call, its name and the rest of the words."""
    command, name = cli, []
    while isinstance(command, click.Group) and words:
        child = command.get_command(click.Context(command), words[0])
        if child is None:
            break
        command, name, words = child, [*name, words[0]], words[1:]
    return command, " ".join(name), words


def flags_of(command: click.Command) -> set[str]:
    own = {flag for each in command.get_params(click.Context(command)) for flag in (*each.opts, *each.secondary_opts)}
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            own |= flags_of(command.get_command(click.Context(command), name))
    return own | {"--help", "--version"}


def check_script(words: list[str]) -> None:
    """`python benchmarks/x.py --flag`: there is such a file, and it knows the flags."""
    script = ROOT / words[0]
    assert script.is_file(), f"{words[0]} is missing"
    code = script.read_text(encoding="utf-8")
    for flag in re.findall(r"--[a-z][\w-]*", " ".join(words[1:])):
        assert f'"{flag}"' in code, f"{words[0]} has no {flag}"


# ---------------------------------------------------------------- a place like the reader's


@pytest.fixture(scope="session")
def prepared(tmp_path_factory):
    """PHOTOS and their camera, OUT as `run` leaves it, MODEL, and the small files that pages name."""
    place = tmp_path_factory.mktemp("docs")
    scene = ROOT / "sample_scenes" / "courtyard"
    (place / "PHOTOS").mkdir()
    for path in sorted((scene / "photos").glob("*.jpg"))[:4]:
        small = cv2.resize(cv2.imread(str(path)), (480, 320), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(place / "PHOTOS" / path.name), small)
    K = [[400.0, 0.0, 243.0], [0.0, 400.0, 156.375], [0.0, 0.0, 1.0]]
    (place / "camera.json").write_text(json.dumps({"width": 480, "height": 320, "K": K, "dist": []}))
    np.savetxt(place / "K.txt", K)
    solving = rs.SolveOptions(shutter_model="rotation")
    outputs = OutputOptions(rs_poses=True, exports=("metashape", "nuke", "opensfm"))
    rs.run(place / "PHOTOS", place / "OUT", rs.RunOptions(max_features=1000, solve=solving, outputs=outputs), jobs=2)
    shutil.copy(place / "OUT" / "metashape" / "cameras.xml", place)
    shutil.copytree(place / "OUT" / "sparse", place / "MODEL")
    shutil.copytree(place / "PHOTOS", place / "STILL")
    shutil.copytree(place / "PHOTOS", place / "SWUNG")
    shutil.copy(scene / "tracks.npz", place / "SCENE.npz")
    shutil.copy(scene / "recipe.json", place / "recipe.json")
    (place / "labels").mkdir()
    cv2.imwrite(str(place / "labels" / "0001.png"), np.zeros((320, 480), np.uint8))
    for name in ("walk.mp4", "database.db", "walk.gcsv", "log.csv", "times.csv", "gcp.csv"):
        (place / name).touch()
    _write_gyroscope(place)
    return place


def _write_gyroscope(place: Path) -> None:
    """A log and times that fit the motions of OUT."""
    (place / "OUT" / "frames").mkdir()
    names = [image.name for image in rs.read_solution(place / "OUT" / "solution.json").images]
    rows = [f"{name},{k},{0.5 * k + 1}" for k, name in enumerate(names)]
    (place / "OUT" / "frames" / "frames.csv").write_text("\n".join(["name,frame,time_s", *rows]) + "\n")
    head = "GYROFLOW IMU LOG\nversion,1.3\norientation,XYZ\ntscale,0.001\ngscale,0.002\nt,gx,gy,gz\n"
    samples = [f"{10 * k},{100 * np.sin(k):.0f},{50 * np.cos(2 * k):.0f},{k % 7}" for k in range(600)]
    (place / "walk.gcsv").write_text(head + "\n".join(samples) + "\n")


def _survey(place: Path) -> None:
    """GPS in PHOTOS, which is 0.5 m off, and gcp.csv, as the scene has them."""
    rng, tracks = np.random.default_rng(4), np.load(ROOT / "sample_scenes" / "courtyard" / "tracks.npz")
    for path, center in zip(sorted((place / "PHOTOS").iterdir()), tracks["center_w"], strict=False):
        fix = rs_io.GpsFix(*geodetic_of([center + rng.normal(0, 0.5, 3)])[0].tolist(), velocity_m_s=(0.0, 0.0, 0.0))
        path.write_bytes(with_position(path.read_bytes(), rs_io.ExifFacts(fix=fix)))
    seen = (tracks["frame_idx"] < 4) & np.isfinite(tracks["xy_raw"]).all(1)
    often = np.flatnonzero(np.bincount(tracks["point_idx"][seen], minlength=len(tracks["points_w"])) == 4)
    rows = ["name,photo,x,y,E,N,U,sigma,use"]
    for k, point in enumerate(rng.choice(often, 8, replace=False).tolist()):
        stated = (
            ",".join(f"{each:.4f}" for each in in_utm(tracks["points_w"][point]))
            + f",0.01,{'check' if k % 2 else 'control'}"
        )
        for row in np.flatnonzero(seen & (tracks["point_idx"] == point)).tolist():
            x, y = (tracks["xy_raw"][row] + 0.5) / 2 - 0.5  # the photos are halved
            rows.append(f"P{k},{tracks['image_names'][tracks['frame_idx'][row]]},{x:.3f},{y:.3f},{stated}")
    (place / "gcp.csv").write_text("\n".join(rows) + "\n")


@pytest.fixture
def place(prepared, tmp_path, monkeypatch):
    """A copy of it, the working folder of one page."""
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ---------------------------------------------------------------- the blocks


@pytest.mark.parametrize("page", PAGES)
def test_blocks_say_what_they_are(page):
    for block in blocks_of(page):
        assert block.language in LANGUAGES, f"{page}:{block.line}: {block.language!r} is none of {sorted(LANGUAGES)}"


@pytest.mark.parametrize("page", with_blocks("python"))
def test_python_runs(page, place):
    """In order and in one namespace; a text block right after one is what it prints. What needs others is compiled."""
    blocks = blocks_of(page)
    printed = {block.follows: block.text for block in blocks if block.language == "text"}
    namespace: dict[str, object] = {}
    for k, block in enumerate(blocks):
        if block.language == "python":
            code = compile("\n" * block.line + block.text, str(PAGES[page]), "exec")
            if block.needs:
                assert block.needs in OTHERS
                continue
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(code, namespace)
            if k in printed:
                assert out.getvalue().rstrip() == printed[k]


@pytest.mark.parametrize("page", with_blocks("json"))
def test_json_is_what_we_read(page, place):
    for block in blocks_of(page):
        if block.language == "json":
            content = json.loads(block.text)
            if "K" in content:
                (place / "camera.json").write_text(block.text)
                assert read_camera_file(place / "camera.json", content["width"], content["height"]).cameras
            else:
                assert set(content) == {"stage", "done", "total", "rate", "eta_s"}


@pytest.mark.parametrize("page", with_blocks("sh"))
def test_commands_are_understood(page, place):
    """By click, in a folder that holds what they name."""
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.M))
    for line in commands_of(page):
        program, *words = words_of(line)
        if program == "rsundistort":
            command, name, rest = resolve(words)
            assert not isinstance(command, click.Group), f"{line}: no such command"
            try:
                command.make_context(name, rest)
            except click.ClickException as error:
                pytest.fail(f"{page}: {line}: {error.format_message()}")
        elif program == "make":
            assert words[0] in targets, f"{line}: no such target"
        elif program == "python":
            check_script(words)
        else:
            assert program in OTHERS, f"{page}: {line}: {program} is not known here"


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in with_blocks("sh") if not page.startswith("sample_scenes")])
def test_commands_run(page, place):
    """One after the other; what an earlier one wrote to the same folder goes first, as the reader would see to it."""
    if page == "docs/survey.md":
        _survey(place)
    for line in commands_of(page):
        program, *words = words_of(line)
        if program != "rsundistort":
            continue
        _, name, rest = resolve(words)
        if any(
            case.split()[: len(name.split())] == name.split() and set(case.split()) <= {*words, *name.split()}
            for case in NOT_RUN
        ):
            continue
        if "-o" in rest and "--overwrite" not in rest:
            shutil.rmtree(rest[rest.index("-o") + 1], ignore_errors=True)
        result = CliRunner().invoke(cli, words)
        assert result.exit_code == 0, f"{page}: {line}: {result.output}"
        if "--gcp" in words:
            stated = rs.read_solution(place / "OUT" / "solution.json").georeference
            checks = [each["residual_m"] for each in stated["control"].values() if each["use"] == "check"]
            # a pixel of these small photos is 2 cm of the scene, 8 m away
            assert len(checks) == 4
            assert np.sqrt(np.mean(np.square(checks))) < 0.05


# ---------------------------------------------------------------- the prose


@pytest.mark.parametrize("page", PAGES)
def test_prose_names_what_exists(page):
    """Commands, flags, scripts and targets between backticks."""
    ours = {name: flags_of(cli.get_command(click.Context(cli), name)) for name in cli.list_commands(click.Context(cli))}
    scripts = "".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "benchmarks").glob("*.py")))
    everywhere = set().union(*ours.values(), re.findall(r'"(--[a-z][\w-]*)"', scripts), {"--regolden"})
    for span in spans_of(page):
        words = span.split()
        if words[0].removeprefix(".venv/bin/") == "rsundistort" and len(words) > 1:
            words = words[1:]
            assert words[0].startswith(("-", "COMMAND")) or words[0] in ours, f"{page}: {span}: no such command"
        if words[0] in ("python", ".venv/bin/python") and words[1].endswith(".py"):
            check_script(words[1:])
        elif words[0].startswith("benchmarks/") and words[0].endswith(".py"):
            check_script(words)
        elif words[0] not in OTHERS:
            known = ours.get(words[0], everywhere)
            for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", span):
                assert flag in known, f"{page}: {span}: no {flag}"


def test_the_readme_names_all_commands():
    named = {span.split()[0] for span in spans_of("README.md")}
    assert not set(cli.list_commands(click.Context(cli))) - named


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    """On the disk, so that pages can be read where the code is; of headings Sphinx takes care."""
    for target in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if "://" not in target and not target.startswith("#"):
            assert (PAGES[page].parent / target.split("#")[0]).exists(), f"{page}: {target}"
