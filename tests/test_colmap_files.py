"""COLMAP's binary files are refused where they claim more than they hold: cut anywhere, counting anything."""

from __future__ import annotations

import shutil
import struct

import pycolmap
import pytest
from bundle_scenes import make_scene

from rsundistort.colmap import read_colmap_cameras, read_colmap_poses, write_colmap_model
from rsundistort.colmap.file_checks import check_colmap_files
from rsundistort.colmap.measured_model import read_colmap_model
from rsundistort.errors import FormatError

PARTS = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model of rigs of two cameras, as COLMAP writes it."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 2, 3, 40
    folder = tmp_path_factory.mktemp("model")
    pycolmap.synthesize_dataset(options).write(folder)
    return folder


@pytest.fixture
def copied(model, tmp_path):
    return shutil.copytree(model, tmp_path / "model")


def test_what_colmap_writes_passes(model):
    assert {path.name for path in model.iterdir()} == set(PARTS)
    check_colmap_files(model)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.97])
def test_a_file_that_was_cut_is_refused_by_name(copied, part, share):
    path = copied / part
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(FormatError, match=rf"{part} is cut short"):
        check_colmap_files(copied)
    for read in (read_colmap_model, read_colmap_poses):
        with pytest.raises(FormatError, match=rf"{part} is cut short"):
            read(copied)


@pytest.mark.parametrize("part", PARTS)
def test_a_count_beyond_the_file_makes_no_room(copied, part):
    path = copied / part
    path.write_bytes(struct.pack("<Q", 2**60) + path.read_bytes()[8:])
    with pytest.raises(FormatError, match=rf"{part} is cut short"):
        read_colmap_model(copied)


def test_a_track_longer_than_the_file_makes_no_room(copied):
    path = copied / "points3D.bin"
    data = bytearray(path.read_bytes())
    data[8 + 43 : 8 + 51] = struct.pack("<Q", 2**31)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"points3D\.bin is cut short"):
        read_colmap_model(copied)


def test_cameras_alone_are_checked_under_any_name(model, tmp_path):
    data = (model / "cameras.bin").read_bytes()
    (tmp_path / "mine.bin").write_bytes(data)
    assert len(read_colmap_cameras(tmp_path / "mine.bin")[0]) == 4
    (tmp_path / "mine.bin").write_bytes(data[:-1])
    with pytest.raises(FormatError, match=r"mine\.bin is cut short"):
        read_colmap_cameras(tmp_path / "mine.bin")


def test_writing_a_model_leaves_what_pycolmap_logs_to_its_user(tmp_path, rng):
    rec = make_scene(rng, "rotation")
    before = pycolmap.logging.minloglevel
    try:
        pycolmap.logging.minloglevel = 1
        cameras = [camera.pinhole() for camera in rec.cameras]
        write_colmap_model(tmp_path / "sparse", rec, cameras, [f"{i}.jpg" for i in range(rec.num_images)])
        assert pycolmap.logging.minloglevel == 1
    finally:
        pycolmap.logging.minloglevel = before
