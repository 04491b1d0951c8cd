"""Features of the shape of their surroundings, which photos with a strong shutter get."""

import warnings
from importlib import import_module
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from plane_photos import CAMERA, texture, views, write

from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import FileError, ReconstructionError, RsUndistortWarning
from rsundistort.input.load import OtherFeatures, load_photos
from rsundistort.io.kept import Kept
from rsundistort.sfm import detect_affine_features, detect_features, reduce_photo
from rsundistort.sfm.descriptor_matches import DescriptorIndex, match_descriptors

placing = import_module("rsundistort.solve.placing")
model_sequence = import_module("rsundistort.solve.model_sequence")

# What a camera that rotates by a third of a radian a frame does to lines of a photo.
SHEAR = np.array([[1.0, 0.4, -50.0], [0.0, 0.75, 40.0]])
# Small photos, since these features take their time.
WIDE, HIGH = 480, 360


def detect(folder, *photos, threads=2):
    folder.mkdir()
    return list(detect_affine_features(photos, 2000, threads, folder))


def num_right(one, other):
    """Matches that the shear explains."""
    found = match_descriptors(DescriptorIndex.of(one.descriptors), DescriptorIndex.of(other.descriptors))
    expected = one.xy_raw[found[:, 0]] @ SHEAR[:, :2].T + SHEAR[:, 2]
    return int((np.linalg.norm(other.xy_raw[found[:, 1]] - expected, axis=1) < 3.0).sum())


def test_a_sheared_photo_matches_more_of_them(tmp_path):
    photo = texture(0, 3.0)[:HIGH, :WIDE]
    sheared = cv2.warpAffine(photo, SHEAR, (WIDE, HIGH), flags=cv2.INTER_LINEAR)
    affine = num_right(*detect(tmp_path / "work", reduce_photo(photo), reduce_photo(sheared)))
    plain = num_right(detect_features(photo, 2000), detect_features(sheared, 2000))
    assert affine > 60
    assert affine > 1.5 * plain


def test_they_lie_where_others_do(tmp_path):
    photo = cv2.resize(texture(3)[:HIGH, :WIDE], None, fx=2.0, fy=2.0)
    (found,) = detect(tmp_path / "work", reduce_photo(photo, megapixels=0.15))
    plain = detect_features(photo, 8192, megapixels=0.15)
    assert found.step_px == plain.step_px > 2.0
    assert (np.diff(found.sigma) <= 0).all()
    gap = found.xy_raw[:, None] - plain.xy_raw
    near = np.linalg.norm(gap, axis=2).argmin(1)
    gap = gap[np.arange(len(gap)), near]
    same = np.linalg.norm(gap, axis=1) < found.step_px
    assert same.mean() > 0.5
    np.testing.assert_allclose(np.median(gap[same], axis=0), 0.0, atol=0.05)


def test_masks_and_empty_photos(tmp_path):
    photo = texture(1)[:HIGH, :WIDE]
    mask = np.zeros_like(photo)
    mask[:, 150:300] = 255
    found, empty = detect(tmp_path / "work", reduce_photo(photo, mask), reduce_photo(np.zeros_like(photo)))
    assert len(found.xy_raw) > 100
    assert found.xy_raw[:, 0].min() > 149
    assert found.xy_raw[:, 0].max() < 300
    assert empty.descriptors.shape == (0, 128)


def test_they_are_the_same_with_any_number_of_threads(tmp_path):
    photos = [reduce_photo(texture(seed)[:200, :250]) for seed in range(3)]
    for one, other in zip(
        detect(tmp_path / "one", *photos, threads=1), detect(tmp_path / "two", *photos, threads=2), strict=True
    ):
        np.testing.assert_array_equal(one.xy_raw, other.xy_raw)
        np.testing.assert_array_equal(one.descriptors, other.descriptors)


def loaded_views(folder, kept):
    log = StageLog(None)
    loaded = load_photos(write(folder, views(texture(0))), CAMERA, "top-to-bottom", 1000, Workers(2), log, kept=kept)
    return OtherFeatures(loaded, 1000, Workers(2), log, 0.1, kept), log


def test_photos_get_them_and_are_verified_with_a_shutter(tmp_path, monkeypatch):
    verified, mapped = [], []

    def take(matched, *_):
        mapped.append(matched)
        raise ReconstructionError("not mapped here")

    monkeypatch.setattr(placing, "verify_with_shutter", lambda _, is_strong: verified.append(is_strong))
    monkeypatch.setattr(placing, "map_photos", take)
    other, log = loaded_views(tmp_path / "in", Kept())
    for photos, is_strong in ((other.photos, False), (other.affine(), True)):
        with pytest.raises(ReconstructionError):
            placing.place_photos(photos, tmp_path, log, 0, "auto", Kept(), with_shutter=True, is_strong=is_strong)
    assert verified == [False, True]
    assert [each.step_px for each in mapped[1].features] == pytest.approx([2.63] * 3, abs=0.01)
    assert mapped[0].database != mapped[1].database


def test_a_run_that_goes_on_does_not_detect_them_again(tmp_path, monkeypatch):
    kept = Kept(tmp_path, "key")
    kept.begin()
    other, _ = loaded_views(tmp_path / "in", kept)
    first = other.affine()
    assert first.affine
    for usual, each in zip(other.photos.features, first.features, strict=True):
        # of the usual ones in all pixels, and as many others at most
        assert 0 < len(each.of_kind(1)) <= 1000
        assert len(each.of_kind(0)) <= 1000
        assert len(usual.of_kind(1)) == 0
    monkeypatch.setattr("rsundistort.input.load.detect_affine_features", None)
    for one, again in zip(first.features, other.affine().features, strict=True):
        np.testing.assert_array_equal(one.descriptors, again.descriptors)
        np.testing.assert_array_equal(one.xy_raw, again.xy_raw)


def by_affine_features(num_registered, num_found, total=6, *, can=True, strong=True, always=False):
    """How many photos the solution that is taken has; None if it is not that of affine features."""

    def solve(mapped, track_source):
        assert (mapped, track_source) == ("mapped", "source")
        warnings.warn("it is so", RsUndistortWarning, stacklevel=2)
        if num_found is None:
            raise ReconstructionError("too few")
        return SimpleNamespace(shared=SimpleNamespace(num_images=num_found))

    def of_affine(is_strong):
        assert is_strong == strong
        return "mapped", "source"

    source = SimpleNamespace(
        of_affine=of_affine if can else None, always_affine=always, matched=SimpleNamespace(names=[""] * total)
    )
    result = SimpleNamespace(reconstruction=SimpleNamespace(num_images=num_registered))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = model_sequence._by_affine_features(source, result, solve, strong)
    # of a solution that is not taken nothing is said
    assert [str(each.message) for each in said] == ["it is so"] * (found is not None)
    return None if found is None else found.shared.num_images


@pytest.fixture
def of_one_scale(monkeypatch):
    """All photos are."""
    monkeypatch.setattr(model_sequence, "num_of_one_scale", lambda rec: rec.num_images)


@pytest.mark.usefixtures("of_one_scale")
def test_a_solution_by_them_is_taken_if_it_has_more_photos():
    assert by_affine_features(4, 5) == 5
    assert by_affine_features(4, 4) is None
    assert by_affine_features(4, None) is None  # a mapping that fails changes nothing
    assert by_affine_features(4, 5, can=False) is None


@pytest.mark.usefixtures("of_one_scale")
def test_nobody_pays_for_them_who_hardly_needs_them():
    assert by_affine_features(6, 7) is None
    assert by_affine_features(91, 100, total=100) is None
    assert by_affine_features(90, 100, total=100) == 100
    assert by_affine_features(4, 5, strong=False) is None


@pytest.mark.usefixtures("of_one_scale")
def test_one_photo_is_reason_enough_where_that_is_wanted(monkeypatch):
    monkeypatch.setattr(model_sequence, "consistent", lambda *_: True)
    for strong in (False, True):
        assert by_affine_features(99, 100, total=100, strong=strong, always=True) == 100
        assert by_affine_features(100, 100, total=100, strong=strong, always=True) is None


def test_photos_that_could_be_scaled_have_no_place(monkeypatch):
    monkeypatch.setattr(model_sequence, "num_of_one_scale", lambda rec: rec.num_images // 2)
    assert by_affine_features(6, 6) is None
    assert by_affine_features(4, 6) == 6


@pytest.mark.usefixtures("of_one_scale")
def test_places_without_a_strong_shutter_must_stay(monkeypatch):
    monkeypatch.setattr(model_sequence, "consistent", lambda *_: False)
    assert by_affine_features(4, 5, strong=False, always=True) is None
    assert by_affine_features(4, 5, strong=True, always=True) == 5


def test_a_photo_that_is_gone_ends_the_run_in_one_line(tmp_path):
    folder, log = write(tmp_path / "in", views(texture(0))), StageLog(None)
    loaded = load_photos(folder, CAMERA, "top-to-bottom", 1000, Workers(2), log)
    (folder / "1.png").unlink()
    with pytest.raises(FileError, match=r"1\.png"):
        OtherFeatures(loaded, 1000, Workers(2), log, 0.1).affine()
