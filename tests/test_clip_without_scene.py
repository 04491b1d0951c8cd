"""A clip without parallax: what its rotations explain stands in for a scene that cannot be triangulated, or is none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rsundistort import BundleOptions
from rsundistort.batch.progress import StageLog
from rsundistort.bundle.path_prior import FramePath
from rsundistort.errors import ReconstructionError, RsUndistortWarning
from rsundistort.solve import video_path
from rsundistort.verdict.judge_path import ReadoutTime

PATH = FramePath({}, 1 / 30)
TURNED, TRAVELLED = "the path of a camera that only rotated", "the path through a scene"
CLIP = SimpleNamespace(names=["a", "b", "c"], time_s=np.arange(3) / 30, frame_s=1 / 30, part=np.zeros(3, int))


@pytest.fixture
def solve(monkeypatch):
    """`solve_clip` of three frames, by what rotations, and a scene if there is one, say of them."""

    def solve(turned, explained, scene=None, filmed=None):
        def travelled(*_):
            if scene is None:
                raise ReconstructionError("no scene point could be triangulated")
            return scene, BundleOptions(path=PATH), filmed, CLIP

        found = turned and (turned, BundleOptions(path=PATH), None, CLIP)
        monkeypatch.setattr(video_path, "_turned", lambda *_: (found, explained))
        monkeypatch.setattr(video_path, "_travelled", travelled)
        return video_path.solve_clip(CLIP, None, PATH, None, None, StageLog(None))

    monkeypatch.setattr(video_path, "own_gyroscope", lambda _: None)
    monkeypatch.setattr(video_path, "readout_of", lambda _: ReadoutTime(0.01, 0.001))
    monkeypatch.setattr(video_path, "_judged", lambda clip, keys, result, *_: result)
    return solve


@pytest.mark.parametrize("explained", [True, False], ids=["all frames", "neighbours alone"])
def test_rotations_stand_in_for_a_scene(solve, explained):
    with pytest.warns(RsUndistortWarning, match="only rotated: without parallax there are directions"):
        assert solve(TURNED, explained) == TURNED


def test_without_them_the_error_says_what_is_missing(solve):
    with pytest.raises(ReconstructionError, match="no scene point"):
        solve(None, explained=False)


STABILISED = SimpleNamespace(verdict="stabilised")


@pytest.mark.parametrize("why", ["stabilised", "no readout"])
def test_a_scene_that_shows_no_readout_is_none_if_rotations_show_one(solve, monkeypatch, why):
    """As of passers-by, before a camera on a tripod."""
    scene = TRAVELLED + " of things that move"
    shown = {TURNED: ReadoutTime(0.01, 0.001), scene: ReadoutTime(0.02, 0.001 if why == "stabilised" else 0.01)}
    monkeypatch.setattr(video_path, "readout_of", shown.__getitem__)
    with pytest.warns(RsUndistortWarning, match="only rotated"):
        assert solve(TURNED, False, scene, STABILISED if why == "stabilised" else None) == TURNED
    # neither shows any: the scene stays
    shown[TURNED] = ReadoutTime(0.01, 0.01)
    assert solve(TURNED, False, scene, STABILISED if why == "stabilised" else None) == scene


def test_a_scene_that_shows_a_readout_stays(solve):
    assert solve(TURNED, False, TRAVELLED) == TRAVELLED
