"""The path of a video whose focal length is hardly known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clips import HandHeld, filmed

from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, GuessedCameras, bundle_adjust
from rsundistort.bundle.path_prior import FramePath
from rsundistort.solve.video_path import _at_first, _is_other_lens, _with_unknown_lens

FRAME_S = 1 / 30


def first_adjustment(zoom=None, off=1.2):
    """The first adjustment of a path from a scene that was mapped by a focal length that is off; and the true one."""
    truth, times = filmed(HandHeld(5), 24, 0.6, **({} if zoom is None else {"zoom": zoom}))
    camera = truth.cameras[0]
    K = camera.K * [[off, 1, 1], [1, off, 1], [1, 1, 1]]
    wrong = replace(truth, cameras=[replace(camera, K=K)], variation=np.zeros((24, 3)))
    mapped = bundle_adjust(wrong, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    guessed = GuessedCameras(tuple(mapped.cameras), {"f": 0.2})
    options = BundleOptions(path=FramePath(times, FRAME_S), refine=("f", "cx", "cy", "k1"), guessed=guessed)
    return _with_unknown_lens(mapped, _at_first(options), StageLog(None)), camera


@pytest.mark.parametrize("off", [0.8, 1.25])
def test_a_wrong_focal_length_is_no_lens_that_varies(off):
    result, camera = first_adjustment(off=off)
    assert not _is_other_lens(result, camera, 0.03)
    assert result.focal_sigma == 0.0


def test_a_lens_that_zooms_varies_where_its_focal_length_is_wrong_too():
    zoom = 1.0 + 0.1 * np.sin(np.arange(24) / 4.0)
    result, _ = first_adjustment(zoom)
    assert 0.03 < result.focal_sigma < 0.3
    assert np.corrcoef(result.reconstruction.variation[:, 0], zoom)[0, 1] > 0.8
