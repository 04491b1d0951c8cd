"""How many attempts mapping makes, and which one counts."""

from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from rsundistort.errors import ReconstructionError
from rsundistort.sfm.mapping import map_photos
from rsundistort.solve.tracks import check_enough

mapping = import_module("rsundistort.sfm.mapping")
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
