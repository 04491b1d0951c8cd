"""Inputs that would be read otherwise than they were meant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bundle_scenes import make_scene

from rsundistort.errors import FormatError, InputError
from rsundistort.input.photo_cameras import camera_file_of
from rsundistort.io import read_known_motions, read_photo_times
from rsundistort.io.gyro import read_gyro
from rsundistort.io.masks import read_mask
from rsundistort.io.surveyed import read_control_points, read_known_lengths


def test_a_decimal_comma_is_no_further_cell(tmp_path):
    table = tmp_path / "known.csv"
    table.write_text("name,phi1,phi2,phi3,sigma\na.jpg,0,01,0,02,0,03,0,001\n")
    with pytest.raises(FormatError, match=r"^.*known\.csv, line 2 has more cells than the 5 columns .* decimal point"):
        read_known_motions(table)
    table.write_text("name,phi1,phi2,phi3,sigma\na.jpg,0.01,0.02,0.03,0.001,,\n")
    assert read_known_motions(table)["a.jpg"][0] == pytest.approx([0.01, 0.02, 0.03])


@pytest.mark.parametrize(("column", "readout_s"), [("phi", None), ("omega", 0.03)])
def test_known_motions_in_degrees_are_refused(tmp_path, column, readout_s):
    table = tmp_path / "known.csv"
    value = 2.0 if readout_s is None else 2.0 / readout_s
    table.write_text(f"name,{column}1,{column}2,{column}3,sigma\na.jpg,0,{value},0,0.001\n")
    with pytest.raises(FormatError, match=rf"line 2 \(a\.jpg\): {column}2=.* which is 2 rad .* degrees"):
        read_known_motions(table, readout_s)


def test_a_gyroscope_in_degrees_is_refused(tmp_path):
    log = tmp_path / "gyro.csv"
    log.write_text("time_s,wx,wy,wz\n0,0,-120,0\n0.01,0,30,0\n")
    with pytest.raises(FormatError, match=r"gyro\.csv has rates up to 120, .* degrees per second"):
        read_gyro(log)


@pytest.mark.parametrize("read", [read_known_motions, read_known_lengths, read_control_points, read_photo_times])
def test_of_two_columns_of_one_name_none_is_taken(tmp_path, read):
    table = tmp_path / "table.csv"
    table.write_text("name,sigma,name \na.jpg,0.1,b.jpg\n")
    with pytest.raises(FormatError, match=r"^.*table\.csv has two columns 'name'; remove one"):
        read(table)


def test_columns_without_a_name_may_be_several(tmp_path):
    table = tmp_path / "times.csv"
    table.write_text("name,time_s,,\na.jpg,1.5,,\n")
    assert read_photo_times(table) == {"a.jpg": 1.5}


def test_a_mask_of_zeros_and_ones_is_not_taken_for_black(tmp_path):
    file = tmp_path / "mask.png"
    cv2.imwrite(str(file), np.eye(8, dtype=np.uint8))
    with pytest.raises(InputError, match="values up to 1, expected 0 and 255"):
        read_mask(file, 8, 8)


def test_a_camera_is_found_beside_the_folder_that_one_is_in(tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    (tmp_path / "camera.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "photos")
    found = camera_file_of(Path("."), None)
    assert found is not None
    assert found.samefile(tmp_path / "camera.json")


def test_photos_that_come_later_have_motions_where_others_are_unsteady(rng):
    scene = make_scene(rng, "rotation", num_images=4, num_points=20)
    bent = replace(scene, bend=np.full((4, 5, 6), 1e-4), bend_clock=np.tile([-0.5, 0.5], (4, 1)))
    more = bent.with_photos(["late.jpg"], np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)), np.full((1, 3), 0.01))
    assert (more.bend_clock[4] == [-1.0, 1.0]).all()
    np.testing.assert_allclose(more.motion(4).phi, 0.01)
