"""Damage inside pixels: what a codec or a checksum detects is reported by photo, and the photo is rectified."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import tifffile
from make_photos import save_png, texture

from rsundistort.errors import DamagedPhotoWarning, FileError
from rsundistort.io.photos.codec_lines import heard
from rsundistort.io.photos.images import read_photo

DEFLATE, LZW = 8, 5


def damaged(path, *options):
    """A photo of which 64 bytes in the middle are others."""
    data = bytearray(cv2.imencode(path.suffix, texture(640, 480), options)[1])
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    return path


def test_a_strip_whose_checksum_is_wrong_is_reported_by_name(tmp_path):
    path = damaged(tmp_path / "a.tif", cv2.IMWRITE_TIFF_COMPRESSION, DEFLATE)
    with pytest.warns(DamagedPhotoWarning, match=r"a\.tif seems damaged: the checksum of 1 of its strips"):
        read_photo(path)


def test_a_whole_tiff_is_read_without_a_word(tmp_path, recwarn):
    path = tmp_path / "a.tif"
    path.write_bytes(bytes(cv2.imencode(".tif", texture(320, 240), [cv2.IMWRITE_TIFF_COMPRESSION, DEFLATE])[1]))
    assert np.array_equal(read_photo(path).pixels, texture(320, 240))
    assert not recwarn


def test_a_tag_that_libtiff_has_no_name_for_is_no_damage(tmp_path, recwarn):
    tifffile.imwrite(tmp_path / "a.tif", texture(64, 48), photometric="rgb", extratags=[(65001, 3, 1, 7, True)])
    with heard():
        read_photo(tmp_path / "a.tif")
    assert not recwarn


def test_a_png_whose_checksum_is_wrong_is_refused_by_name(tmp_path):
    with heard(), pytest.raises(FileError, match=r"a\.png cannot be decoded"):
        read_photo(damaged(tmp_path / "a.png"))


def test_of_photos_that_are_read_side_by_side_the_damaged_one_is_reported(tmp_path):
    names = [f"{k}.jpg" for k in range(12)]
    for seed, name in enumerate(names):
        (tmp_path / name).write_bytes(bytes(cv2.imencode(".jpg", texture(320, 240, seed))[1]))
    damaged(tmp_path / names[7])
    with pytest.warns(DamagedPhotoWarning) as said, heard(), ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda name: read_photo(tmp_path / name), names))
    assert len(said) == 1
    assert str(said[0].message).startswith("7.jpg seems damaged: Corrupt JPEG data")


LISTENS = """
import os, sys
from rsundistort.io.photos.codec_lines import heard
with heard():
    print("python", file=sys.stderr)
    os.write(2, b"native\\n")
    os.write(2, b"Corrupt JPEG data: 3 extraneous bytes\\n")
print("after", file=sys.stderr)
os.write(2, b"native after\\n")
"""


def test_other_lines_on_stderr_pass(tmp_path):
    done = subprocess.run([sys.executable, "-c", LISTENS], capture_output=True, text=True, check=True)
    assert sorted(done.stderr.split("\n")[:4]) == ["after", "native", "native after", "python"]


def test_nothing_is_heard_where_stderr_is_closed(tmp_path):
    closed = "import os; os.close(2)\nfrom rsundistort.io.photos.codec_lines import heard\nwith heard(): print('done')"
    done = subprocess.run([sys.executable, "-c", closed], stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout == "done\n"


def test_the_command_tells_a_damaged_tiff_of_each_packing(tmp_path, invoke):
    """Its photo is rectified: what is seen of it may be worth having."""
    photos = tmp_path / "photos"
    photos.mkdir()
    damaged(photos / "a.tif", cv2.IMWRITE_TIFF_COMPRESSION, LZW)
    save_png(photos / "b.png", texture(640, 480, 1))
    camera = "600,600,319.5,239.5"
    done = invoke("simulate", "warp", photos, "--camera", camera, "-o", tmp_path / "out")
    assert done.exit_code == 0
    assert "a.tif seems damaged: " in done.stderr
    assert (tmp_path / "out" / "photos" / "a.tif").is_file()
