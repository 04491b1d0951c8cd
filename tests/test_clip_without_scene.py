"""A clip without parallax: what its rotations explain stands in for a scene that cannot be triangulated."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rsundistort import BundleOptions
from rsundistort.batch.progress import StageLog
from rsundistort.bundle.path_prior import FramePath
from rsundistort.errors import ReconstructionError, RsUndistortWarning
from rsundistort.solve import video_path
from rsundistort.verdict.judge_path import ReadoutTime

PATH = FramePath({}, 1 / 30)
TURNED = "the path of a camera that only rotated"


@pytest.fixture
def solve(monkeypatch):
    """`solve_clip` of three frames without parallax, by what rotations say of them."""

    def travelled(*_):
        raise ReconstructionError("no scene point could be triangulated")

    def solve(turned, explained):
        clip = SimpleNamespace(names=["a", "b", "c"])
        found = turned and (turned, BundleOptions(path=PATH), None, clip)
        monkeypatch.setattr(video_path, "_turned", lambda *_: (found, explained))
        return video_path.solve_clip(clip, None, PATH, None, None, StageLog(None))

    monkeypatch.setattr(video_path, "_travelled", travelled)
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
