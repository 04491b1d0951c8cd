"""The camera of a video for programs that play it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera
from rsundistort.model.path import CameraPath
from rsundistort.model.track import CameraTrack, ShownFrames, camera_track

CAMERA = Camera(643, 361, [[500, 0, 320], [0, 500, 180], [0, 0, 1]])


def path_of(time_s, rng):
    m = len(time_s)
    R_cw = Rotation.from_rotvec(rng.normal(0, 0.2, (m, 3))).as_matrix()
    return CameraPath(time_s, R_cw, rng.normal(0, 1, (m, 3)), *np.zeros((4, m, 3)))


def test_each_frame_of_the_file_has_the_pose_of_what_it_shows(rng):
    """A clip of 24 frames a second that was converted to 30: every fifth comes twice; the last is not on the path."""
    names = tuple(f"{k}.png" for k in range(9))
    path = path_of(np.arange(8) / 24, rng)
    shown = ShownFrames(np.arange(11) / 30, tuple(names[k] for k in (0, 1, 2, 3, 3, 4, 5, 6, 7, 7, 8)))
    track = camera_track(path, names[:8], shown, CAMERA)
    assert track.numbers.tolist() == list(range(10))
    assert 1 / track.frame_s == pytest.approx(30)
    np.testing.assert_array_equal(track.center_w, path.center_w[[0, 1, 2, 3, 3, 4, 5, 6, 7, 7]])
    np.testing.assert_array_equal(track.R_cw, path.R_cw[[0, 1, 2, 3, 3, 4, 5, 6, 7, 7]])
    assert track.camera == CAMERA


def test_the_frames_of_a_coded_video_have_even_sides(rng):
    path = path_of(np.arange(3) / 25, rng)
    shown = ShownFrames(path.time_s, ("a", "b", "c"))
    camera = camera_track(path, shown.names, shown, CAMERA, even=True).camera
    assert (camera.width, camera.height) == (642, 360)
    np.testing.assert_array_equal(camera.K, CAMERA.K)


@pytest.mark.parametrize("fps", [Fraction(24), Fraction(30000, 1001), Fraction(30), Fraction(60), Fraction(120)])
def test_time_stamps_in_whole_milliseconds_count_every_frame(fps):
    """As MKV and WebM have them: of 33, 33, 34 ms the median is 33, by which the frame 1000 was called 1010."""
    numbers = np.delete(np.arange(1800), np.s_[700:1100])
    shown = ShownFrames(np.round(numbers / float(fps), 3), tuple(map(str, numbers)))
    assert 1 / shown.frame_s == pytest.approx(float(fps), rel=1e-3 / shown.time_s[-1])
    track = CameraTrack(shown.time_s, shown.frame_s, np.zeros((0, 3, 3)), np.zeros((0, 3)), CAMERA)
    assert track.numbers.tolist() == numbers.tolist()


def test_frames_at_uneven_times_keep_them():
    track = CameraTrack(np.array([0, 1, 2.5, 3, 5.2]) / 25, 1 / 25, np.zeros((5, 3, 3)), np.zeros((5, 3)), CAMERA)
    np.testing.assert_allclose(track.numbers, [0, 1, 2.5, 3, 5.2])
