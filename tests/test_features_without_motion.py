"""Features of photos whose lens and rotation are taken out before these are detected."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from plane_photos import CAMERA, texture, views, write

from rsundistort import Camera, Observations, Reconstruction, RowMotion, distort_points, undistort_points
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import InputError
from rsundistort.input.load import OtherFeatures, load_photos
from rsundistort.input.without_motion import photo_without_motion
from rsundistort.sfm import detect_features
from rsundistort.sfm.descriptor_matches import DescriptorIndex, match_descriptors
from rsundistort.solve.placing import match_without_motions
from rsundistort.synthetic import warp_photo

SIZE = 640, 480
LENS = Camera(*SIZE, [[600, 0, 320], [0, 600, 240], [0, 0, 1]], [-0.1, 0.02, 0.0, 0.0])
# a third of a radian a frame
MOTION = RowMotion(np.array([0.2, -0.2, 0.15]) / LENS.frame_span)


@pytest.fixture(scope="module")
def photo():
    """A photo, and what the moving camera makes of it."""
    still = texture(0, 3.0)[: SIZE[1], : SIZE[0]]
    return still, warp_photo(still, LENS, MOTION)[0]


def without_motion(pixels, mask=None):
    rectified, seen, frame = photo_without_motion(pixels, mask, LENS, MOTION, 1.0)
    return frame.in_photo(detect_features(rectified, 2000, seen))


def matches_where(one, other, off):
    """How many matches lie within two pixels of where they should."""
    found = match_descriptors(DescriptorIndex.of(one.descriptors), DescriptorIndex.of(other.descriptors))
    return int((np.linalg.norm(off(one.xy_raw[found[:, 0]]) - other.xy_raw[found[:, 1]], axis=1) < 2.0).sum())


def test_they_match_those_of_the_photo_as_it_was(photo):
    still, moved = photo
    of_still = photo_without_motion(still, None, LENS, RowMotion(), 1.0)
    before = of_still[2].in_photo(detect_features(of_still[0], 2000, of_still[1]))

    def in_moved(xy):
        return distort_points(undistort_points(xy, LENS, P=LENS.K), LENS, MOTION, P=LENS.K)

    found = matches_where(before, without_motion(moved), in_moved)
    sheared = matches_where(detect_features(still, 2000), detect_features(moved, 2000), in_moved)
    assert found > 1.5 * sheared > 500


def test_all_of_a_photo_has_its_features(photo):
    moved = photo[1]
    xy = without_motion(moved).xy_raw
    assert (xy > -0.5).all()
    assert (xy < np.array(SIZE) - 0.5).all()
    # none at the borders, where what is missing would be a feature
    low, high = xy.min(axis=0), np.array(SIZE) - 1 - xy.max(axis=0)
    assert (low > 4).all()
    assert (high > 4).all()
    assert (low < 40).all()
    assert (high < 40).all()


def test_masks_count(photo):
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :320] = 0
    xy = without_motion(photo[1], mask).xy_raw
    assert len(xy) > 100
    assert xy[:, 0].min() > 320


def solution_of(names, camera):
    """A reconstruction in which some photos rotate."""
    num = len(names)
    return Reconstruction(
        [camera], names, np.zeros(num, int), np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 3)), np.ones((1, 3)),
        Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))), np.tile(MOTION.phi, (num, 1)),
        shutter_model="rotation",
    )  # fmt: skip


def without_motions(other, rec, before):
    own = {name: rec.camera(i) for i, name in enumerate(rec.image_names)}
    return other.without_motions(own, dict(zip(rec.image_names, rec.phi, strict=True)), before)


@pytest.fixture
def loaded(tmp_path):
    log = StageLog(None)
    photos = load_photos(write(tmp_path / "in", views(texture(0))), CAMERA, "top-to-bottom", 1000, Workers(2), log)
    return photos, OtherFeatures(photos, 1000, Workers(2), log, 0.1)


def test_photos_without_a_motion_keep_theirs(loaded):
    photos, other = loaded
    found = without_motions(other, solution_of(photos.names[:2], photos.cameras.cameras[0]), photos.features)
    assert found.features[2] is photos.features[2]
    for old, new in zip(photos.features[:2], found.features[:2], strict=True):
        assert len(new.xy_raw) > 100
        assert new.kind is None
        assert new.step_px == pytest.approx(2.63, abs=0.01)
        assert not np.array_equal(new.xy_raw[:50], old.xy_raw[:50])


def test_those_of_a_fisheye_stay(loaded):
    photos, other = loaded
    fisheye = Camera(960, 720, photos.cameras.cameras[0].K, np.zeros(4), lens="fisheye")
    found = without_motions(other, solution_of(photos.names, fisheye), photos.features)
    assert all(new is old for new, old in zip(found.features, photos.features, strict=True))


def test_kinds_stay(loaded):
    photos, other = loaded
    found = without_motions(other, solution_of(photos.names[:1], photos.cameras.cameras[0]), other.affine().features)
    assert {*found.features[0].kind.tolist()} == {0, 1}


def test_pairs_are_verified_without_motions(loaded, tmp_path):
    photos, _ = loaded
    (tmp_path / "work").mkdir()
    rec = solution_of(photos.names, photos.cameras.cameras[0])
    matched = match_without_motions(photos, rec, tmp_path / "work", StageLog(None), 0, "auto", {})
    assert matched.cameras == tuple(rec.cameras)
    assert all(one is other for one, other in zip(matched.features, photos.features, strict=True))
    assert matched.database.is_file()


def test_photos_whose_masks_exclude_all_of_them_are_named(tmp_path):
    folder = write(tmp_path / "in", views(texture(0)))
    (tmp_path / "masks").mkdir()

    def load(black):
        for name in ("0.png", "1.png", "2.png"):
            mask = np.full((720, 960), 0 if name in black else 255, np.uint8)
            cv2.imwrite(str(tmp_path / "masks" / name), mask)
        return load_photos(
            folder, CAMERA, "top-to-bottom", 1000, Workers(2), StageLog(None), megapixels=0.1, masks=tmp_path / "masks"
        )

    photos = load(["1.png"])
    assert photos.unregistered(["0.png"]) == {
        "1.png": "its mask excludes all that it shows", "2.png": "shares too little with the other photos",
    }  # fmt: skip
    with pytest.raises(InputError, match=r"no photo shows a feature \(0\.png: its mask excludes all"):
        load(["0.png", "1.png", "2.png"])


def test_frames_stay_within_what_can_be_rectified():
    """A photo that is nearly as wide as OpenCV takes it."""
    camera = Camera(32700, 20, [[30000, 0, 16350], [0, 30000, 10], [0, 0, 1]])
    pixels = np.zeros((20, 32700), np.uint8)
    frame = photo_without_motion(pixels, None, camera, RowMotion(np.array([0.0, 100.0, 0.0])), 1.0)[2]
    assert 32700 < frame.target.width <= 32766
