"""Folders that hold no scene, or more than one: a result or one line, never a traceback."""

import shutil
import warnings

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from make_photos import COURTYARD_NAMES, half_courtyard, save_png
from rsundistort_cli.main import cli

from rsundistort import read_solution


def tried(folder, *args):
    """Exit code, what is said on stderr, and the solution if there is one."""
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = CliRunner().invoke(
            cli, ["run", "photos", "-o", "out", "--quiet", "--no-report", "--max-features", "700", *args]
        )
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert "Traceback" not in result.output
    solution = read_solution("out/solution.json") if result.exit_code == 0 else None
    if solution is None:
        assert result.exit_code == 1
        assert len([line for line in result.stderr.splitlines() if line.startswith("error: ")]) == 1
        assert not (folder / "out").exists()
    return solution, result.stderr


@pytest.fixture
def photos(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


def of_one_colour(k):
    return np.full((240, 320, 3), 60 + k, np.uint8)


def of_noise(k):
    return np.random.default_rng(k).integers(0, 255, (240, 320, 3), np.uint8)


def of_a_pattern(k):
    tile = np.kron(np.indices((15, 20)).sum(0) % 2, np.ones((16, 16)))
    return np.roll(np.repeat((255 * tile).astype(np.uint8)[..., None], 3, 2), 3 * k, axis=1)


def of_one_row(k):
    return np.random.default_rng(k).integers(0, 255, (1, 320, 3), np.uint8)


@pytest.mark.parametrize("photo_of", [of_one_colour, of_noise, of_a_pattern, of_one_row])
def test_photos_without_a_scene(photos, photo_of):
    for k in range(4):
        save_png(photos / f"{k}.png", photo_of(k))
    height, width = photo_of(0).shape[:2]
    solution, said = tried(photos.parent, "--camera", f"300,300,{width / 2},{height / 2}")
    if photo_of is of_a_pattern:  # it may be taken for a scene
        assert solution is not None or "use photos" in said
    else:
        assert solution is None
        assert ("320x1 pixels, too few" if photo_of is of_one_row else "use photos") in said


def test_one_photo_over_and_over(photos):
    whole = half_courtyard(photos.parent / "scene")
    for k in range(4):
        shutil.copy(whole / COURTYARD_NAMES[0], photos / f"{k}.png")
    solution, said = tried(photos.parent, "--camera", str(whole.parent / "camera.json"))
    assert solution is not None or "use photos" in said


def test_a_photo_that_is_there_twice_ruins_nothing(photos):
    whole = half_courtyard(photos.parent / "scene")
    for path in whole.iterdir():
        shutil.copy(path, photos / path.name)
    shutil.copy(whole / COURTYARD_NAMES[2], photos / "again.png")
    solution, _ = tried(photos.parent, "--camera", str(whole.parent / "camera.json"), "--model", "rotation")
    assert len(solution.registered) == len(COURTYARD_NAMES) + 1
    original, again = solution.image(COURTYARD_NAMES[2]), solution.image("again.png")
    np.testing.assert_allclose(original.center_w, again.center_w, atol=0.02)


@pytest.mark.slow
def test_of_two_scenes_the_larger_is_solved_and_the_other_named(photos):
    whole = half_courtyard(photos.parent / "scene")
    for name in COURTYARD_NAMES[:6]:
        shutil.copy(whole / name, photos / name)
    for path in [whole / name for name in COURTYARD_NAMES[:3]]:
        # upside down and inside out, no feature is one of the others'
        save_png(photos / f"other-{path.name}", 255 - cv2.imread(str(path))[:, ::-1])
    solution, _ = tried(photos.parent, "--camera", str(whole.parent / "camera.json"), "--model", "rotation")
    registered = {image.name for image in solution.registered}
    assert registered == set(COURTYARD_NAMES[:6])
    others = [image.reason for image in solution.images if image.name not in registered]
    assert others == ["shows another scene, with 2 other photos; put them in a folder of their own"] * 3


def test_three_photos(photos):
    whole = half_courtyard(photos.parent / "scene")
    for name in COURTYARD_NAMES[:3]:
        shutil.copy(whole / name, photos / name)
    solution, said = tried(photos.parent, "--camera", str(whole.parent / "camera.json"))
    assert solution is not None or "use photos" in said
    if solution is not None:
        # they are bent by tens of pixels, and said to be
        assert solution.shutter_model != "global"


def test_a_photo_that_is_a_pixel_narrower(photos):
    whole = half_courtyard(photos.parent / "scene")
    for path in whole.iterdir():
        shutil.copy(path, photos / path.name)
    name = COURTYARD_NAMES[3]
    save_png(photos / name, cv2.imread(str(whole / name))[:, :-1])
    solution, said = tried(photos.parent, "--camera", "400,400,200,150")
    assert solution is not None or name in said or "pixels" in said
