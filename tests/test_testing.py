"""The golden-image helper: what passes, what fails, and what a failure leaves to look at."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from rsundistort.errors import FileError, InputError
from rsundistort.testing import Golden, assert_images_close

pytest_plugins = ["pytester"]


def photo(rng, shape=(20, 30), dtype=np.uint8):
    if np.dtype(dtype).kind == "f":
        return rng.uniform(0.2, 0.8, shape).astype(dtype)
    return rng.integers(40, 200, shape).astype(dtype) * np.array(1 if dtype == np.uint8 else 257, dtype)


@pytest.mark.parametrize(
    ("dtype", "max_grey", "within", "beyond"),
    [
        (np.uint8, 2, 2, 3),
        (np.uint8, 0, 0, 1),
        (np.uint16, 2, 514, 515),  # a grey level of 8 bit is 257 steps
        (np.uint16, 0.5, 128, 129),
        (np.float32, 0.25, 0.24, 0.26),  # floats in their own unit
        (np.float64, 2.0, 1.9, 2.1),
    ],
)
def test_tolerance_is_in_grey_levels_and_for_floats_absolute(dtype, max_grey, within, beyond, rng, tmp_path):
    for shape in ((20, 30), (20, 30, 3)):
        expected = photo(rng, shape, dtype)
        for sign in (-1, 1):  # unsigned integers must not wrap around
            got = expected.copy()
            got[3, 4] = (got[3, 4].astype(float) + sign * within).astype(dtype)
            assert_images_close(got, expected, max_grey=max_grey)
            got[3, 4] = (expected[3, 4].astype(float) + sign * beyond).astype(dtype)
            with pytest.raises(AssertionError, match=r"1 of 600 pixels \(0\.167%\) differ by more than"):
                assert_images_close(got, expected, max_grey=max_grey, out=tmp_path)


def test_share_of_pixels_may_exceed_the_tolerance(rng, tmp_path):
    expected = photo(rng, (10, 10, 3))
    got = expected.copy()
    got[0, :5, 1] += 50  # five pixels, in one channel
    assert_images_close(got, expected, max_grey=2, max_share=0.05)
    with pytest.raises(AssertionError, match=r"5 of 100 pixels \(5\.000%\) differ .*; 4\.900% may"):
        assert_images_close(got, expected, max_grey=2, max_share=0.049, out=tmp_path)


def test_only_pixels_of_the_mask_are_compared(rng, tmp_path):
    expected = photo(rng)
    got = expected.copy()
    got[:5] = 0
    mask = np.full(expected.shape, 255, np.uint8)
    mask[:5] = 0
    assert_images_close(got, expected, max_grey=0, mask=mask)
    got[5, 0] = 0
    with pytest.raises(AssertionError, match="1 of 450 pixels"):
        assert_images_close(got, expected, max_grey=0, mask=mask > 0, out=tmp_path)


def test_failure_says_where_and_writes_three_pictures(rng, tmp_path):
    expected = photo(rng)
    got = expected.copy()
    got[7, 11] += 30
    got[2, 3] += 6
    got[0, 0] += 2
    with pytest.raises(AssertionError) as failure:
        assert_images_close(got, expected, max_grey=4, out=tmp_path / "new" / "folder")
    text = str(failure.value)
    assert f"worst: 30 grey levels at row 7, column 11: got {got[7, 11]}, expected {expected[7, 11]}" in text
    pictures = {}
    for name in ("expected", "got", "difference"):
        path = tmp_path / "new" / "folder" / f"{name}.png"
        assert f"{name}: {path}" in text
        pictures[name] = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(pictures["expected"], expected)
    np.testing.assert_array_equal(pictures["got"], got)
    # what is beyond is bright even where it is small beside the worst, what is within is dark, what is equal is black
    difference = pictures["difference"]
    assert difference[7, 11] == 255
    assert 160 <= difference[2, 3] < 255
    assert 0 < difference[0, 0] <= 100
    assert np.count_nonzero(difference) == 3


def test_without_a_folder_the_pictures_are_temporary_files(rng, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(AssertionError) as failure:
        assert_images_close(photo(rng), photo(rng), max_grey=0)
    named = [Path(line.split(": ")[1]) for line in str(failure.value).splitlines()[2:]]
    assert [path.name for path in named] == ["expected.png", "got.png", "difference.png"]
    assert all(path.is_file() and tmp_path in path.parents for path in named)


@pytest.mark.parametrize("shape", [(6, 7), (6, 7, 2), (6, 7, 3), (6, 7, 4), (6, 7, 5)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_failure_can_be_looked_at_for_every_kind_of_picture(dtype, shape, rng, tmp_path):
    expected = photo(rng, shape, dtype)
    got = expected.copy()
    got[0, 0] = np.nan if np.dtype(dtype).kind == "f" else 0
    with pytest.raises(AssertionError, match="1 of 42 pixels"):
        assert_images_close(got, expected, max_grey=0.01, out=tmp_path)
    for name in ("expected", "got", "difference"):
        assert cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_UNCHANGED).shape[:2] == (6, 7)


def test_nan_and_infinity_equal_only_themselves(tmp_path):
    expected = np.array([[np.nan, np.inf, -np.inf, 1.0]])
    assert_images_close(expected, expected.copy(), max_grey=0)
    for other in ([[0.0, np.inf, -np.inf, 1]], [[np.nan, 5.0, -np.inf, 1]], [[np.nan, np.inf, np.inf, 1]]):
        with pytest.raises(AssertionError, match="1 of 4 pixels"):
            assert_images_close(np.array(other), expected, max_grey=1e300, out=tmp_path)


def test_expected_may_be_a_file(rng, tmp_path):
    for suffix, dtype in ((".png", np.uint8), (".png", np.uint16), (".tif", np.float32)):
        expected = photo(rng, dtype=dtype)
        assert cv2.imwrite(str(tmp_path / f"expected{suffix}"), expected)
        assert_images_close(expected, tmp_path / f"expected{suffix}", max_grey=0)
        assert_images_close(expected[..., None], str(tmp_path / f"expected{suffix}"), max_grey=0)
    np.save(tmp_path / "expected.npy", expected)
    assert_images_close(expected, tmp_path / "expected.npy", max_grey=0)
    np.savez(tmp_path / "expected.npz", expected)
    assert_images_close(expected, tmp_path / "expected.npz", max_grey=0)


def test_files_that_are_no_picture_are_named(rng, tmp_path):
    for name in ("broken.png", "broken.npy", "broken.npz"):
        (tmp_path / name).write_bytes(b"no picture")
        with pytest.raises(FileError, match=rf"broken\.{name[-3:]}"):
            assert_images_close(photo(rng), tmp_path / name, max_grey=0)
    np.savez(tmp_path / "two.npz", a=photo(rng), b=photo(rng))
    with pytest.raises(InputError, match=r"two\.npz holds 2 arrays, expected one"):
        assert_images_close(photo(rng), tmp_path / "two.npz", max_grey=0)


def test_other_shapes_and_types_do_not_compare(rng, tmp_path):
    got = photo(rng)
    for expected in (photo(rng, (20, 31)), photo(rng, (20, 30, 3)), photo(rng, dtype=np.uint16), got / 255):
        with pytest.raises(AssertionError, match=r"got uint8 \(20, 30\), expected .*: these do not compare") as failure:
            assert_images_close(got, expected, max_grey=255, out=tmp_path)
        assert str(tmp_path / "expected.png") in str(failure.value)
        assert (tmp_path / "got.png").is_file()


def test_missing_golden_file_says_how_to_make_it(rng, tmp_path):
    with pytest.raises(AssertionError, match=r"new\.png is missing; make it with pytest --regolden"):
        assert_images_close(photo(rng), tmp_path / "new.png", max_grey=0)
    with pytest.raises(AssertionError, match=r"new\.npy is missing; make it with pytest --regolden"):
        Golden(tmp_path, tmp_path).array("new.npy", photo(rng), atol=0)


def test_arguments_that_make_no_comparison_are_refused(rng):
    image = photo(rng)
    for kwargs, text in (
        ({"max_grey": -1}, "max_grey=-1, expected 0 or more"),
        ({"max_grey": float("nan")}, "max_grey=nan, expected 0 or more"),
        ({"max_grey": 0, "max_share": 1.5}, "max_share=1.5, expected 0 to 1"),
        ({"max_grey": 0, "mask": np.zeros(image.shape)}, "mask leaves no pixel to compare"),
        ({"max_grey": 0, "mask": np.ones((3, 3))}, r"mask\.shape=\(3, 3\), expected \(20, 30\)"),
    ):
        with pytest.raises(InputError, match=text):
            assert_images_close(image, image, **kwargs)
    for wrong in (image > 100, image.astype(int), image[0], image[:0], np.zeros((2, 2, 2, 2), np.uint8)):
        with pytest.raises(InputError, match=r"expected uint8, uint16 or floats \(h, w\[, channels\]\)"):
            assert_images_close(wrong, image, max_grey=0)


@pytest.mark.parametrize("name", ["a.png", "scene/b.npz", "c.npy"])
def test_golden_file_is_made_on_request_and_then_compared_with(name, rng, tmp_path):
    golden, making = (Golden(tmp_path / "golden", tmp_path / "out", remake) for remake in (False, True))
    values = photo(rng, (9, 12, 3), np.uint16 if name.endswith("png") else np.float32)

    def compare(which, got):
        if name.endswith("png"):
            which.image(name, got, max_grey=1)
        else:
            which.array(name, got, atol=1e-3)

    compare(making, values)
    compare(golden, values)
    other = values.copy()
    other[1, 2, 0] = 0
    with pytest.raises(AssertionError, match="1 of "):
        compare(golden, other)
    compare(making, other)
    compare(golden, other)


def test_failing_array_says_where_and_keeps_what_was_got(rng, tmp_path):
    golden, making = (Golden(tmp_path / "golden", tmp_path / "out", remake) for remake in (False, True))
    values = rng.normal(size=(5, 6, 2))
    making.array("grid.npz", values, atol=0)
    other = values.copy()
    other[4, 3, 1] += 0.5
    with pytest.raises(
        AssertionError, match=r"1 of 60 numbers .*more than 0\.1\nworst: 0\.5 at \[4, 3, 1\]"
    ) as failure:
        golden.array("grid.npz", other, atol=0.1)
    assert str(tmp_path / "out" / "grid.npz") in str(failure.value)
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "grid.npz")["array"], other)
    for wrong in (values[1:], values.astype(np.float32)):
        with pytest.raises(AssertionError, match="these do not compare"):
            golden.array("grid.npz", wrong, atol=0.1)
    with pytest.raises(InputError, match="atol=nan"):
        golden.array("grid.npz", values, atol=float("nan"))


def test_golden_files_hold_what_they_can_hold_without_loss(rng, tmp_path):
    golden = Golden(tmp_path, tmp_path, remake=True)
    for name, values in (("a.jpg", photo(rng)), ("a.png", photo(rng, dtype=np.float32))):
        with pytest.raises(InputError, match=r"golden images are uint8 or uint16, and PNG.*golden\.array"):
            golden.image(name, values, max_grey=0)
    for name, values in (("a.png", photo(rng)), ("a.npy", np.array(["text"]))):
        with pytest.raises(InputError, match=r"golden arrays hold real numbers and are \.npy or \.npz"):
            golden.array(name, values, atol=0)


USERS_TEST = """
import numpy as np

def test_picture(golden):
    golden.image("picture.png", np.full((4, 5), VALUE, np.uint8), max_grey=3)
    golden.array("numbers.npz", np.full(3, float(VALUE)), atol=3)
"""


def test_users_have_the_option_and_the_fixture(pytester):
    def outcomes(value, *options):
        pytester.makepyfile(USERS_TEST.replace("VALUE", str(value)))
        return pytester.runpytest(*options)

    missing = outcomes(100)
    missing.assert_outcomes(failed=1)
    missing.stdout.fnmatch_lines(["*golden*picture.png is missing; make it with pytest --regolden*"])
    made = outcomes(100, "--regolden")
    made.assert_outcomes(passed=1)
    made.stdout.fnmatch_lines(["golden files: written, not compared (--regolden)"])
    assert sorted(p.name for p in (pytester.path / "golden").iterdir()) == ["numbers.npz", "picture.png"]
    outcomes(102).assert_outcomes(passed=1)
    changed = outcomes(110)
    changed.assert_outcomes(failed=1)
    changed.stdout.fnmatch_lines(["*20 of 20 pixels (100.000%) differ by more than 3 grey levels*"])
    outcomes(110, "--regolden").assert_outcomes(passed=1)
    outcomes(110).assert_outcomes(passed=1)


def test_the_plugin_costs_nothing_at_the_start_of_pytest():
    code = "import sys, rsundistort_cli.pytest_plugin; print({'numpy', 'cv2', 'numba', 'click'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "set()"
