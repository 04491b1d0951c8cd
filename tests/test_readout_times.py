"""The table of readout times."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

import rsundistort.io.readout_times as table
from rsundistort.io import readout_time

ROWS = list(csv.DictReader(Path(table.__file__).with_suffix(".csv").read_text(encoding="utf-8").splitlines()))


@pytest.mark.parametrize(
    ("make", "model", "width", "height", "readout_ms"),
    [
        ("DJI", "FC8482", 4032, 3024, 21),
        ("DJI", "FC8482", 8064, 4536, 43),
        ("DJI", "FC8482", 3024, 4032, 21),  # portrait
        (" dji\0\0", "fc8482 \0", 4032, 3024, 21),
        ("Hasselblad", "L1D-20c", 5472, 3648, 56),
        ("HASSELBLAD", "L1D 20C", 5472, 3648, 56),
        ("NIKON CORPORATION", "NIKON Z 9", 8256, 5504, 3.73),
        ("GoPro", "GoPro HERO4 Black", 4000, 3000, 30),
        ("Apple", "iPhone  6s", 1280, 720, 15.01),
    ],
)
def test_lookups(make, model, width, height, readout_ms):
    seconds, source = readout_time(make, model, width, height)
    assert seconds == pytest.approx(readout_ms / 1e3)
    assert source


@pytest.mark.parametrize(
    ("make", "model", "width", "height"),
    [
        ("DJI", "FC8482", 1920, 1080),  # a mode that nobody measured
        ("DJI", "FC9999", 4032, 3024),
        ("Apple", "FC8482", 4032, 3024),
        ("Apple", "iPhone 4", 1920, 1080),
        ("", "", 0, 0),
        ("\0", "", 640, 480),
    ],
)
def test_unknown_cameras_and_modes(make, model, width, height):
    assert readout_time(make, model, width, height) is None


def test_sources_that_name_no_size_say_so():
    seconds, source = readout_time("DJI", "FC330", 4000, 3000)
    assert seconds == pytest.approx(0.033)
    assert source.endswith("for no stated size")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['model']}-{row['width']}")
def test_every_row_can_be_looked_up_and_has_a_source(row):
    assert None not in row.values()
    assert len(row["source"]) > 10
    assert bool(row["width"]) == bool(row["height"])
    seconds, source = readout_time(row["make"], row["model"], int(row["width"] or 1), int(row["height"] or 1))
    assert seconds == pytest.approx(float(row["readout_ms"]) / 1e3)
    assert 1e-3 < seconds < 0.2
    assert source.startswith(row["source"])


def test_no_camera_is_there_twice_with_one_size():
    keys = [(table._key(row["make"], row["model"]), *sorted((row["width"], row["height"]))) for row in ROWS]
    assert len(set(keys)) == len(keys)
