"""How many attempts mapping makes, and which one counts."""

from dataclasses import dataclass, replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from bundle_scenes import make_scene
from matched_scene import matched_scene

from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.errors import ReconstructionError
from rsundistort.sfm.epipolar import read_matches, read_verified
from rsundistort.sfm.mapping import map_photos
from rsundistort.solve.tracks import check_enough

mapping, placing = map(import_module, ("rsundistort.sfm.mapping", "rsundistort.solve.placing"))
MATCHED = SimpleNamespace(names=[f"{k}.jpg" for k in range(16)])


@pytest.fixture
def attempts(monkeypatch):
    """Attempts made, by their keypoints or "one by one"; `registers` says how many photos each takes."""
    made, registers = [], {}

    def of(attempt):
        made.append(attempt)
        count = registers.get(attempt, 0)
        return SimpleNamespace(num_images=count, by=attempt) if attempt in registers else None

    monkeypatch.setattr(mapping, "_mapped_at_once", lambda _, limit, *__: of(limit))
    monkeypatch.setattr(mapping, "_mapped_one_by_one", lambda *_: of("one by one"))
    return made, registers


@pytest.mark.parametrize(
    ("registers", "made", "by"),
    [
        pytest.param({2048: 16}, [2048], 2048, id="all"),
        pytest.param({2048: 14, 4096: 14, None: 16}, [2048, 4096], 2048, id="twice-as-many-place-no-more"),
        pytest.param({2048: 13, 4096: 14, None: 14}, [2048, 4096, None], 4096, id="twice-as-many-place-more"),
        pytest.param({2048: 8, 4096: 8, None: 13}, [2048, 4096, None], None, id="too-few-to-end"),
        pytest.param(
            {2048: 8, "one by one": 9}, [2048, 4096, None, "one by one"], "one by one", id="a-quarter-left-out"
        ),
        pytest.param({None: 9, "one by one": 9}, [2048, 4096, None, "one by one"], None, id="of-equals-the-first"),
    ],
)
def test_mapping_tries_more_keypoints_while_they_may_place_more_photos(attempts, registers, made, by):
    attempts[1].update(registers)
    assert map_photos(MATCHED).by == by
    assert attempts[0] == made


@pytest.mark.parametrize("registers", [{}, {2048: 0, "one by one": 0}], ids=["none", "without-a-point"])
def test_photos_that_no_attempt_registers_are_refused(attempts, registers):
    attempts[1].update(registers)
    with pytest.raises(ReconstructionError, match="none of the 16 photos overlap enough to be registered"):
        map_photos(MATCHED)
    assert attempts[0] == [2048, 4096, None, "one by one"]


@pytest.mark.parametrize(("apart", "says"), [(0.01, "show no parallax"), (1.0, "could be registered")])
def test_photos_from_one_spot_are_told_so(apart, says):
    before = SimpleNamespace(center_w=np.array([[0.0, 0, 0], [apart, 0, 0]]), size=5.0)
    with pytest.raises(ReconstructionError, match=says):
        check_enough(SimpleNamespace(num_images=0), 12, before)


@pytest.fixture
def key_frames(monkeypatch):
    """Focal lengths that key frames were mapped by, where the maps come one after the other and fit so many matches."""

    def key_frames(*maps):
        by, rest = [], iter(maps)

        def map_photos(matched, _=None, __=None, keypoints=None, rough=None):
            by.append(matched.cameras)
            found = next(rest)
            if found is None:
                raise ReconstructionError("too few")
            name, num_images, fitting = found
            return SimpleNamespace(name=name, cameras=f"lens of {name}", num_images=num_images, fitting=fitting)

        monkeypatch.setattr(placing, "map_photos", map_photos)
        monkeypatch.setattr(placing, "_num_fitting", lambda _, mapped: mapped.fitting)
        monkeypatch.setattr(placing, "consistent", lambda a, b: a.name[0] == b.name[0])
        found = placing.map_key_frames(Key("given"))
        assert next(rest, None) is None, "a map was not asked for"
        return found.name, by

    return key_frames


@dataclass(frozen=True)
class Key:
    cameras: str


def test_key_frames_are_mapped_until_two_maps_agree(key_frames):
    assert key_frames(("a", 9, 50), ("a again", 9, 50)) == ("a again", ["given", "lens of a"])
    turned = ("a", 9, 50), ("b", 9, 60), ("b again", 9, 61)
    assert key_frames(*turned) == ("b again", ["given", "lens of a", "lens of b"])


@pytest.mark.parametrize("other", [("b", 8, 60), ("b", 9, 49), None], ids=["fewer", "fits-less", "none"])
def test_another_map_of_key_frames_that_is_worse_is_not_taken(key_frames, other):
    assert key_frames(("a", 9, 50), other)[0] == "a"


def test_key_frames_are_not_mapped_for_ever(key_frames):
    assert key_frames(("a", 9, 50), ("b", 9, 51), ("c", 9, 52), ("d", 9, 53))[0] == "d"


def test_where_poses_are_rough_the_matches_that_fit_them_map(tmp_path, rng):
    scene = make_scene(rng, "global", num_points=200)
    matched = matched_scene(scene, rng, tmp_path / "all.db", share_wrong=0.2)
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:  # all of them as if an epipolar geometry fitted
        db.clear_two_view_geometries()
        for (i, j), matches in read_matches(matched).items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            geometry.inlier_matches = matches.astype(np.uint32)
            db.write_two_view_geometry(i + 1, j + 1, geometry)
    posed = scene.take_photos(np.arange(scene.num_images) > 0)
    small = mapping._mapping_database(matched, tmp_path, None, posed)
    found = read_verified(replace(matched, database=small))
    assert len(found) == 15
    for pair, matches in read_matches(matched).items():
        of_all = found[pair]
        if 0 in pair:  # one without a pose
            np.testing.assert_array_equal(of_all, matches)
        else:
            right = matches[:, 0] == matches[:, 1]  # each photo shows all points
            # a wrong match may lie on its epipolar line by chance
            assert len(of_all) < len(right)
            assert np.isin(np.flatnonzero(right), of_all[:, 0]).all()
            assert (of_all[:, 0] == of_all[:, 1]).mean() > 0.95
