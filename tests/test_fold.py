from __future__ import annotations

import re

import numpy as np
import pytest
from numpy_reference import Fisheye, lens_of
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion
from rsundistort.errors import InputError
from rsundistort.model import READOUTS, Bend
from rsundistort.synthetic.fold import check_no_fold
from rsundistort.synthetic.lens import undistort_to_rays

K = [[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]
# farthest pixel from the principal row: 240 rows above it, the last one is 239 below
R_MAX, C_MAX = 240 / 500, 320 / 500
LENS = [-0.12, 0.03, 0.001, -0.002]
FISHEYE = Fisheye([0.03, -0.01, 0.004, -0.001])


def camera_of(readout="top-to-bottom", dist=()):
    return Camera(640, 480, K, np.array(dist), readout, lens_of(dist))


def check(camera, phi, velocity=None, depth=None, bend=None):
    check_no_fold("b.png", camera, RowMotion(phi, np.zeros(3) if velocity is None else velocity, bend), depth)


def folds(*args, **kwargs):
    try:
        check(*args, **kwargs)
    except InputError:
        return True
    return False


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("dist", [(), LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_motions_of_a_hand_pass(readout, dist, rng):
    camera = camera_of(readout, dist)
    for _ in range(5):
        check(camera, rng.normal(size=3) * 0.1)
    check(camera, np.zeros(3))
    check(camera, rng.normal(size=3) * 0.1, [0.1, -0.2, 0.1], 3.0)


# the axis along the lines pulls the image along the readout, by phi (1 + r^2): by hand, for each direction
THRESHOLDS = {
    "top-to-bottom": [-1 / (1 + R_MAX**2), 0, 0],
    "bottom-to-top": [1 / (1 + R_MAX**2), 0, 0],
    "left-to-right": [0, 1 / (1 + C_MAX**2), 0],
    "right-to-left": [0, -1 / (1 + C_MAX**2), 0],
}


@pytest.mark.parametrize(("readout", "phi"), THRESHOLDS.items())
def test_rows_fold_at_the_rotation_computed_by_hand(readout, phi):
    camera, phi = camera_of(readout), np.array(phi)
    check(camera, phi * (1 - 1e-6))
    line = "rows" if READOUTS[readout][0] == 1 else "columns"
    with pytest.raises(InputError, match=re.escape(f"the {line} of b.png fold over: at pixel (0, 0)")):
        check(camera, phi * (1 + 1e-6))
    # the other way round the image runs against the readout: the rows spread, they do not fold
    check(camera, -2 * phi)


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("sign", [1, -1])
def test_rows_fold_at_the_roll_computed_by_hand(readout, sign):
    """Rolling moves the rows at the sides, by phi3 c a row, and columns at top and bottom: up here, down there."""
    camera = Camera(641, 481, K, readout=readout)  # as far to the left as to the right of the principal point
    threshold = sign / (C_MAX if READOUTS[readout][0] == 1 else R_MAX)
    assert not folds(camera, [0, 0, threshold * (1 - 1e-6)])
    assert folds(camera, [0, 0, threshold * (1 + 1e-6)])


@pytest.mark.parametrize("readout", READOUTS)
def test_rows_fold_where_translation_follows_the_readout(readout):
    """A wall at depth d runs at -v/d against the camera, wherever it is seen."""
    axis, sign = READOUTS[readout]
    velocity = np.zeros(3)
    velocity[axis] = -4.0 * sign
    camera = camera_of(readout)
    assert not folds(camera, np.zeros(3), velocity, 4.0 * (1 + 1e-6))
    assert folds(camera, np.zeros(3), velocity, 4.0 * (1 - 1e-6))
    assert not folds(camera, np.zeros(3), -velocity, 1.0)
    assert not folds(camera, np.zeros(3), velocity)  # at infinity nothing moves
    assert not folds(camera, np.zeros(3), velocity, np.inf)


def test_nearest_thing_of_a_depth_map_counts():
    depth = np.full((480, 640), np.inf)
    velocity = [0.0, -4.0, 0.0]
    assert not folds(camera_of(), np.zeros(3), velocity, depth)
    depth[100:103, 201:204] = 3.9  # finer than the grid
    with pytest.raises(InputError, match=r"at pixel \((200|180), (90|105)\)"):
        check(camera_of(), np.zeros(3), velocity, depth)
    depth[100:103, 201:204] = 4.1
    assert not folds(camera_of(), np.zeros(3), velocity, depth)


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("dist", [(), LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_rows_fold_where_the_map_to_directions_turns_over(readout, dist, rng):
    """Counted another way: small triangles of pixels whose directions go round the other way."""
    camera = camera_of(readout, dist)
    K, (axis, sign) = camera.K, READOUTS[readout]
    v, u = np.mgrid[0:479:33j, 0:639:33j]
    uv = np.stack([u, v], -1)[:, :, None] + 0.01 * np.array([[0, 0], [1, 0], [0, 1]])
    clock = sign * (uv[..., axis] - K[axis, 2]) / K[axis, axis]
    rays = np.concatenate([undistort_to_rays(uv, camera), np.ones((*uv.shape[:-1], 1))], -1)

    def turns_over(phi):
        turn = Rotation.from_rotvec(-clock.reshape(-1, 1) * phi)
        directions = turn.apply(rays.reshape(-1, 3)).reshape(rays.shape)
        return bool((np.linalg.det(directions) < 0).any())

    found = []
    for _ in range(40):
        phi = rng.normal(size=3) * 0.8
        found.append(folds(camera, phi))
        if found[-1]:
            assert turns_over(1.02 * phi)
        else:
            assert not turns_over(0.98 * phi)
    assert 5 < sum(found) < 35


def seen_twice(camera, phi, velocity, depth):
    """Whether two lines of the photo see one point, not nearer than the depth: densely, without a derivative."""
    K, (axis, sign) = camera.K, READOUTS[camera.readout]
    size = np.array([camera.width, camera.height])
    uv = np.stack(np.meshgrid(np.linspace(0, size[0] - 1, 9), np.linspace(0, size[1] - 1, 9)), -1).reshape(-1, 2)
    clock = sign * (np.linspace(0, size[axis] - 1, 401) - K[axis, 2]) / K[axis, axis]
    own = sign * (uv[:, axis] - K[axis, 2]) / K[axis, axis]
    rays = np.column_stack([(uv - K[:2, 2]) / np.diag(K)[:2], np.ones(len(uv))]) * depth
    # points in the frame of the camera at clock zero
    points = Rotation.from_rotvec(-own[:, None] * phi).apply(rays) + own[:, None] * velocity
    turns, t = Rotation.from_rotvec(clock[:, None] * phi).as_matrix(), clock[:, None]
    seen = (points - t[..., None] * velocity) @ turns.transpose(0, 2, 1)
    near = seen[..., 2]
    late = sign * seen[..., axis] / near - t
    across = (seen[..., 1 - axis] / near * K[1 - axis, 1 - axis] + K[1 - axis, 2]) / (size[1 - axis] - 1)
    met = ((late[1:] >= 0) != (late[:-1] >= 0)) & (across[1:] >= 0) & (across[1:] <= 1) & (near[1:] > 0.999 * depth)
    return bool((met.sum(0) > 1).any())


@pytest.mark.parametrize("readout", READOUTS)
def test_no_point_of_what_passes_is_seen_twice(readout, rng):
    camera, passed, twice = camera_of(readout), 0, 0
    for _ in range(60):
        phi, velocity, depth = rng.normal(size=3) * 0.4, rng.normal(size=3) * 3, rng.uniform(3, 5)
        refused = folds(camera, phi, velocity, depth)
        found = seen_twice(camera, phi, velocity, depth)
        assert refused or not found
        passed, twice = passed + (not refused), twice + found
    assert passed > 10
    assert twice > 0


def test_speed_is_taken_through_the_lens():
    """At the edge of a barrel lens a direction runs over fewer pixels a radian, so faster rotations pass."""
    phi = np.array([-1 / (1 + R_MAX**2), 0, 0]) * 1.02
    assert folds(camera_of(), phi)
    assert not folds(camera_of(dist=[-0.2, 0.0, 0.0, 0.0]), phi)
    assert folds(camera_of(dist=[0.2, 0.0, 0.0, 0.0]), phi * 0.95)


@pytest.mark.parametrize(
    ("phi", "velocity", "depth", "says"),
    [
        ([0, 0], None, None, "phi"),
        ([0, 0, np.nan], None, None, "phi"),
        ([0, 0, 0], [0, 1], 1.0, "velocity"),
        ([0, 0, 0], [0, 1, 0], 0.0, "b.png: a depth of 0"),
        ([0, 0, 0], [0, 1, 0], -2.0, "b.png: a depth of -2"),
        ([0, 0, 0], [0, 1, 0], np.nan, "b.png"),
        ([0, 0, 0], [0, 1, 0], np.full((480, 640), np.nan), "b.png"),
        ([0, 0, 0], [0, 1, 0], np.ones((640, 480)), "depth.shape"),
    ],
)
def test_bad_arguments_are_refused(phi, velocity, depth, says):
    with pytest.raises(InputError, match=says):
        check(camera_of(), phi, velocity, depth)


def test_bends_count_by_their_own_rate():
    """Rows fold where the rotation is fastest, and not by its mean: half a period of a vibration, computed by hand."""
    camera, (start, end) = camera_of(), (-R_MAX, 239 / 500)
    middle = (start + end) / 2
    # the rate of -a sin(k r) is -a k in the middle row, where 1 + r^2 is 1, and nothing at the ends
    k = np.pi / (end - start)

    def shaken(amplitude):
        r = np.linspace(start, end, 65)
        return Bend(start, end, np.outer(-amplitude * np.sin(k * (r - middle)), [1, 0, 0]))

    assert not folds(camera, np.zeros(3), bend=shaken(0.99 / k))
    assert folds(camera, np.zeros(3), bend=shaken(1.01 / k))
    assert not folds(camera, [0.3, 0, 0], bend=shaken(1.2 / k))  # a rotation the other way makes up for it


def test_travel_that_is_not_steady_folds_rows_by_its_own_rate():
    camera, (start, end) = camera_of(), (-R_MAX, 239 / 500)
    clock = np.linspace(start, end, 9)
    way = np.outer(2.0 * (clock - clock.mean()) ** 2, [0, -1, 0])  # at most 4 (end - start) / 2 of speed
    fastest = 2.0 * (end - start)
    bend = Bend(start, end, np.zeros((9, 3)), way)
    assert folds(camera, np.zeros(3), None, fastest * 0.98, bend)
    assert not folds(camera, np.zeros(3), None, fastest * 1.02, bend)
    assert not folds(camera, np.zeros(3), None, None, bend)
