"""Features of fewer pixels, where these match well enough."""

from importlib import import_module

import numpy as np
import pytest
from plane_photos import CAMERA, SIZE, texture, views, write

from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import ReconstructionError
from rsundistort.input.load import OtherFeatures, load_photos
from rsundistort.io.kept import Kept
from rsundistort.sfm import read_num_verified

placing = import_module("rsundistort.solve.placing")


def load(folder, **options):
    return load_photos(folder, CAMERA, "top-to-bottom", 8192, Workers(2), StageLog(None), **options)


@pytest.fixture
def seen(monkeypatch):
    """Matched photos that are to be mapped; mapping itself ends there."""
    taken = []

    def take(matched, *_):
        taken.append(matched)
        raise ReconstructionError("not mapped here")

    monkeypatch.setattr(placing, "map_photos", take)
    return taken


def place(folder):
    scratch, log = folder.with_name(f"scratch of {folder.name}"), StageLog(None)
    scratch.mkdir()
    loaded = load(folder, coarse=True)
    with pytest.raises(ReconstructionError):
        placing.place_photos(
            loaded, scratch, log, 0, "auto", Kept(),
            other=OtherFeatures(loaded, 8192, Workers(2), log, 1.0),
        )  # fmt: skip
    return log


def test_photos_that_show_many_features_in_fewer_pixels_are_detected_there(tmp_path):
    folder = write(tmp_path / "in", [*views(texture(0)), texture(1, 25.0)[: SIZE[1], : SIZE[0]]])
    loaded = load(folder, coarse=True)
    assert loaded.coarse == {"0.png", "1.png", "2.png"}
    # a third of the pixels; the last shows too little even in all pixels, and has all that these show
    assert [each.step_px for each in loaded.features] == pytest.approx([1.73, 1.73, 1.73, 1.0], abs=0.01)
    assert all(len(each.xy_raw) >= 3000 for each in loaded.features[:3])


def test_finer_features_are_those_of_photos_that_were_never_coarse(tmp_path):
    folder = write(tmp_path / "in", views(texture(0)))
    finer = OtherFeatures(load(folder, coarse=True), 8192, Workers(2), StageLog(None), 1.0).finer()
    assert not finer.coarse
    for one, other in zip(finer.features, load(folder).features, strict=True):
        np.testing.assert_array_equal(one.xy_raw, other.xy_raw)
        np.testing.assert_array_equal(one.descriptors, other.descriptors)


def test_coarse_features_do_where_they_match(tmp_path, seen):
    log = place(write(tmp_path / "in", views(texture(0))))
    assert [each.step_px for each in seen[0].features] == pytest.approx([1.73] * 3, abs=0.01)
    assert [stage["name"] for stage in log.stages] == ["matching"]


def test_finer_ones_are_taken_where_a_photo_matches_too_little(tmp_path, seen):
    others = views(texture(0))
    log = place(write(tmp_path / "in", [*others, texture(1)[: SIZE[1], : SIZE[0]]]))
    assert [each.step_px for each in seen[0].features] == pytest.approx([1.0] * 4, abs=0.01)
    assert [stage["name"] for stage in log.stages] == ["matching", "features", "matching"]


def test_of_many_photos_some_pairs_say_whether_coarse_features_do(tmp_path, seen, monkeypatch):
    monkeypatch.setattr(placing, "_ASKED", 2)
    log = place(write(tmp_path / "in", views(texture(0), 4)))
    assert log.stages[0]["pairs"] == 6  # all of them in the end
    assert len(read_num_verified(seen[0])) == 6
    alien = write(tmp_path / "alien", [texture(seed)[: SIZE[1], : SIZE[0]] for seed in range(4)])
    log = place(alien)
    assert log.stages[0]["rich"] is False
    assert seen[1].features[0].step_px == pytest.approx(1.0, abs=0.01)
