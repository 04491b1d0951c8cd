"""Photos side by side take no more memory than there is."""

from __future__ import annotations

import os
import warnings

import cv2
import numpy as np
import psutil
import pytest
from make_photos import texture

from rsundistort import (
    Camera,
    RowMotion,
    RsUndistortWarning,
    Solution,
    SolvedImage,
    rectify_folder,
    write_solution,
)
from rsundistort.batch import workers as workers_module
from rsundistort.batch.memory import free_memory, return_memory
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import SkippedPhotoWarning
from rsundistort.input.load import load_photos
from rsundistort.io import read_photo
from rsundistort.io.photos.images import stored_size
from rsundistort.sfm import detect_features, detection_bytes


def make_group(root, path, limit, used, cache=0, version=2):
    folder = root / "sys/fs/cgroup" / ("." if version == 2 else "memory") / path
    folder.mkdir(parents=True, exist_ok=True)
    names = ("max", "current") if version == 2 else ("limit_in_bytes", "usage_in_bytes")
    files = [f"{'' if version == 2 else 'total_'}{how}active_file {cache // 2}" for how in ("in", "")]
    for name, text in (*zip(names, (limit, used), strict=True), ("stat", "\n".join(["anon 7", *files]))):
        (folder / f"memory.{name}").write_text(f"{text}\n")


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """One of 1,000 free bytes, and a process in the control group a/b."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 1000}))
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text("4:cpu,memory:/a/b\n1:name=systemd:/old\n0::/a/b\n")
    return tmp_path


def test_memory_is_what_the_machine_has(machine):
    assert free_memory(machine / "of another system") == 1000
    assert free_memory(machine) == 1000
    make_group(machine, "a/b", "max", 400)
    assert free_memory(machine) == 1000


@pytest.mark.parametrize("path", ["a/b", "a", "."])
@pytest.mark.parametrize("version", [1, 2])
def test_memory_is_what_control_groups_leave(machine, path, version):
    make_group(machine, path, 500, 300, 50, version)
    assert free_memory(machine) == 250
    make_group(machine, path, 500, 600, 0, version)
    assert free_memory(machine) == 0
    make_group(machine, path, 9223372036854771712, 600, 0, version)
    assert free_memory(machine) == 1000


def test_this_machine_has_memory():
    assert 0 < free_memory() <= psutil.virtual_memory().total


@pytest.mark.parametrize(("each", "jobs", "threads_each"), [(50, 8, 1), (94, 7, 1), (200, 3, 2), (5000, 1, 8)])
def test_only_as_many_photos_as_fit(monkeypatch, each, jobs, threads_each):
    monkeypatch.setattr(workers_module, "free_memory", lambda: 1000)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fitting = Workers(8).fitting("rectifying", each)
    assert fitting == Workers(jobs, None, threads_each)
    stated = [str(each.message).split(" at once")[0] for each in said]
    assert stated == [f"rectifying: {jobs} of 8 photos"] * (jobs < 8)


def test_photos_of_no_size_need_no_memory():
    assert Workers(8).fitting("features", 0.0).jobs == 8


def test_a_cluster_minds_its_own_memory(monkeypatch):
    monkeypatch.setattr(workers_module, "free_memory", lambda: 0)
    assert Workers(8, "tcp://there:8786").fitting("rectifying", 1e9) == Workers(8, "tcp://there:8786")


def test_little_memory_changes_no_result(tmp_path, monkeypatch):
    camera = Camera(90, 60, [[80, 0, 44.5], [0, 80, 29.5], [0, 0, 1]])
    names = [f"{k}.png" for k in range(4)]
    (tmp_path / "in").mkdir()
    for k, name in enumerate(names):
        cv2.imwrite(str(tmp_path / "in" / name), np.roll(texture(90, 60), 5 * k, axis=1))
    images = tuple(SolvedImage(name, "1", motion=RowMotion([0.02, 0.01 * k, 0.0])) for k, name in enumerate(names))
    write_solution(tmp_path / "s.json", Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, images))
    rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "much", jobs=4)
    monkeypatch.setattr(workers_module, "free_memory", lambda: 500_000)
    with pytest.warns(RsUndistortWarning, match="rectifying: 2 of 4 photos at once"):
        rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "little", jobs=4)
    for name in names:
        assert (tmp_path / "little/images" / name).read_bytes() == (tmp_path / "much/images" / name).read_bytes()


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_sizes_are_read_from_the_headers(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8))
    assert stored_size(path) == (300, 200)
    path.unlink()  # nothing holds it
    path.write_bytes(b"")
    assert stored_size(path) is None


def test_photos_that_are_refused_do_not_count(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(Workers, "fitting", lambda self, what, each: asked.append(each) or self)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), texture(90, 60))
    cv2.imwrite(str(tmp_path / "large.png"), texture(400, 300))
    with pytest.warns(SkippedPhotoWarning, match=r"large\.png has 400x300 pixels"):
        load_photos(tmp_path, "80,80,44.5,29.5", None, 500, Workers(1), StageLog(None), max_megapixels=0.1)
    assert asked == [90 * 60 * (245 + 16)]


def test_a_photo_that_changes_while_it_is_read_is_what_was_checked(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    before, after = texture(90, 60), 255 - texture(90, 60)
    cv2.imwrite(str(path), before)
    read = cv2.imread

    def too_late(*args):
        cv2.imwrite(str(path), after)
        os.utime(path, ns=(1, 1))
        return read(*args)

    monkeypatch.setattr(cv2, "imread", too_late)
    np.testing.assert_array_equal(read_photo(path).pixels, before)


# ---------------------------------------------------------------- features of large photos


def dots(width, height, sigma, seed=0):
    """Gaussian dots, bright and dark, and where they are."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(40, width - 40, 60), np.arange(40, height - 40, 60))
    xy = np.stack([x.ravel(), y.ravel()], 1) + rng.uniform(-5, 5, (x.size, 2))
    sign = rng.choice([-1.0, 1.0], len(xy))
    u, v = np.arange(width)[None, :], np.arange(height)[:, None]
    photo = np.full((height, width), 128.0)
    for (cx, cy), s in zip(xy, sign, strict=True):
        photo += 90 * s * np.exp(-((u - cx) ** 2) / (2 * sigma**2)) * np.exp(-((v - cy) ** 2) / (2 * sigma**2))
    return np.rint(photo).astype(np.uint8), xy


@pytest.mark.parametrize(
    ("limit", "factor"), [(10**9, 1), (200_000, 1.1), (150_000, 1.27), (60_000, 2), (40_000, 2.46)]
)
def test_features_of_shrunk_photos_are_where_they_should_be(limit, factor):
    photo, truth = dots(601, 403, 3.0 * factor)  # of one size for SIFT
    found = detect_features(photo, megapixels=limit / 1e6)
    off = np.linalg.norm(truth[:, None] - found.xy_raw[None], axis=2).min(1)
    # half a pixel of a halved photo, were its corner forgotten
    assert np.median(off) < 0.05
    assert off.max() < 0.1 * factor
    assert found.sigma.min() >= factor
    assert detection_bytes(601, 403, limit / 1e6) == pytest.approx(245 * 601 * 403 / factor**2, rel=0.02)


def test_masks_of_shrunk_photos_hide_what_they_did():
    photo, truth = dots(601, 403, 4.0)
    mask = np.full(photo.shape, 255, np.uint8)
    mask[:, 300:] = 0
    xy = detect_features(photo, mask=mask, megapixels=0.1).xy_raw
    assert len(xy) > 20
    assert xy[:, 0].max() < 300
    assert (truth[:, 0] > 300).any()


def test_memory_is_returned_where_the_allocator_can(monkeypatch):
    called = []
    monkeypatch.setattr("psutil.heap_trim", lambda: called.append(True), raising=False)
    return_memory()
    assert called == [True]
    monkeypatch.delattr("psutil.heap_trim")
    return_memory()
