"""Coarse grids against the exact model, and grids as files: there and back, by a reader of OpenEXR's own."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import numpy_reference
import pytest
from numpy_reference import DIRECTIONS, MODELS, Fisheye
from scipy.ndimage import map_coordinates

from rsundistort import Camera, Plane, RemapGrid, RowMotion, init_rectify_map, rectify, undistort_points
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.rectify import largest_shift_px
from rsundistort.rectify.coarse_grid import TOLERANCE_PX, coarse_grid
from rsundistort.rectify.maps import EDGE_PX, fill_rows, rectified_rays

W, H = 640, 480
K = np.array([[520.0, 0, 315.3], [0, 510.0, 246.6], [0, 0, 1]])
make_camera = partial(numpy_reference.make_camera, W, H, K)
LENS = [-0.12, 0.03, 0.001, -0.002]
FISHEYE = Fisheye([0.03, -0.01, 0.004, -0.001])
RATIONAL = [0.1, -0.05, 0.001, -0.002, 0.01, 0.25, 0.02, 0.005, 0.002, -0.001, 0.001, 0.0015]
WILD = [-0.5, 0.9, 0.01, -0.02, -1.2]
MOTION = RowMotion([0.09, -0.06, 0.08])
FAST = RowMotion([0.2, -0.15, 0.18])

lenses = pytest.mark.parametrize(
    "dist", [[], LENS, RATIONAL, WILD, FISHEYE], ids=["pinhole", "lens", "rational", "wild", "fisheye"]
)
all_directions = pytest.mark.parametrize("readout", DIRECTIONS)
all_models = pytest.mark.parametrize("model", MODELS)


def whole(grid, width, height):
    """The map of a coarse grid and its mask, in one piece."""
    map_x, map_y = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    seen = np.empty((height, width), np.uint8)
    assert grid.fill(0, map_x, map_y, seen) == bool(seen.all())
    return map_x, map_y, seen


def inside(map_x, map_y, width=W, height=H):
    """Where a map points into the source; float32 maps."""
    x_in = (map_x >= -EDGE_PX) & (map_x <= width - 1 + EDGE_PX)
    return x_in & (map_y >= -EDGE_PX) & (map_y <= height - 1 + EDGE_PX)


def smooth_photo(rng, sigma=4.0, shape=(H, W)):
    noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma)
    return ((noise - noise.min()) / np.ptp(noise)).astype(np.float32)


# ---------------------------------------------------------------------------------------------- coarse grids


@lenses
@all_directions
@pytest.mark.parametrize("motion", [MOTION, FAST], ids=["some", "fast"])
def test_interpolated_map_is_within_its_bound_and_the_mask_is_exact(motion, readout, dist):
    camera = make_camera(dist, readout)
    wide = np.array([[430.0, 0, 372], [0, 420, 297], [0, 0, 1]])  # sees beyond the borders of the photo
    rays = rectified_rays(wide, None, camera)
    grid = coarse_grid(camera, motion, "rotation", rays, (740, 600))
    assert 0 <= grid.error_px <= TOLERANCE_PX
    map_x, map_y, seen = whole(grid, 740, 600)
    exact_x, exact_y = init_rectify_map(camera, motion, new_K=wide, size=(740, 600))
    # float32 of numbers to 1000
    assert max(abs(map_x - exact_x).max(), abs(map_y - exact_y).max()) <= grid.error_px + 1e-4
    np.testing.assert_array_equal(seen > 0, inside(exact_x, exact_y))
    assert 0.1 < (seen > 0).mean() < 1


@all_models
def test_every_model_is_interpolated(model):
    camera = make_camera(LENS)
    grid = coarse_grid(camera, MOTION, model, rectified_rays(None, None, camera), (W, H))
    assert grid.smooth.all()
    map_x, map_y, _ = whole(grid, W, H)
    exact = init_rectify_map(camera, MOTION, model)
    assert max(abs(map_x - exact[0]).max(), abs(map_y - exact[1]).max()) <= grid.error_px + 1e-4


def test_large_photos_have_few_nodes_and_a_small_error():
    camera = Camera(4000, 3000, [[3000, 0, 1990], [0, 3010, 1510], [0, 0, 1]], LENS)
    rays = rectified_rays(None, None, camera)
    grid = coarse_grid(camera, MOTION, "rotation", rays, (4000, 3000))
    assert grid.smooth.all()
    assert grid.nodes_x.size < 4000 * 3000 / 3000
    for row0 in (0, 1501, 2992):
        found, exact = (np.empty((2, 8, 4000), np.float32) for _ in range(2))
        grid.fill(row0, *found, np.empty((8, 4000), np.uint8))
        fill_rows(camera, MOTION, "rotation", rays, row0, *exact)
        assert abs(found - exact).max() <= grid.error_px + 3e-4  # float32 of numbers to 4096


def test_where_the_lens_folds_pixels_are_evaluated_one_by_one():
    camera = Camera(W, H, K, [-0.6, 0, 0, 0])  # folds at 0.745
    wide = np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]])
    grid = coarse_grid(camera, MOTION, "rotation", rectified_rays(wide, None, camera), (W, H))
    assert not grid.smooth.all()
    assert grid.error_px <= TOLERANCE_PX
    map_x, map_y, seen = whole(grid, W, H)
    exact_x, exact_y = init_rectify_map(camera, MOTION, new_K=wide)
    assert max(abs(map_x - exact_x).max(), abs(map_y - exact_y).max()) <= grid.error_px + 1e-4
    np.testing.assert_array_equal(seen > 0, inside(exact_x, exact_y))


def test_maps_of_strips_are_those_of_the_whole():
    camera = make_camera(LENS)
    grid = coarse_grid(camera, MOTION, "rotation", rectified_rays(None, None, camera), (W, H))
    expected = whole(grid, W, H)
    for row0, row1 in ((0, 1), (1, 97), (97, 480)):
        found = [np.empty((row1 - row0, W), each.dtype) for each in expected]
        grid.fill(row0, *found)
        for part, entire in zip(found, expected, strict=True):
            np.testing.assert_array_equal(part, entire[row0:row1])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32], ids=["uint8", "uint16", "float32"])
def test_rectified_photo_is_that_of_the_exact_map(dtype, rng):
    camera = make_camera(LENS)
    photo = (smooth_photo(rng) * (1 if dtype == np.float32 else np.iinfo(dtype).max)).astype(dtype)
    rectified, mask = rectify(photo, camera, MOTION, interpolation="linear")
    maps = init_rectify_map(camera, MOTION)
    expected = cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    steep = max(abs(np.diff(photo.astype(float), axis=axis)).max() for axis in (0, 1))
    off = abs(rectified.astype(float) - expected)[mask > 0].max()
    # 1/32 px of OpenCV's linear (where it is not exact), rounded on either side, in x and y; half a grey level each
    assert off <= 2 * steep / 32 + (1 if dtype != np.float32 else 1e-6)


# ---------------------------------------------------------------------------------------------- grids as values


@pytest.mark.parametrize("dist", [[], LENS, RATIONAL, FISHEYE], ids=["pinhole", "lens", "rational", "fisheye"])
@all_directions
def test_forward_and_inverse_compose_to_identity(readout, dist):
    grid = RemapGrid.from_camera(make_camera(dist, readout), FAST)
    inverse = grid.inverse()
    assert inverse.size == (W, H)
    assert (inverse.source_width, inverse.source_height) == grid.size
    u, v = np.meshgrid(np.arange(0, W, 3), np.arange(0, H, 3))
    for there, back in ((grid, inverse), (inverse, grid)):
        at = [back.map_y[v, u], back.map_x[v, u]]
        x, y = (
            map_coordinates(np.where(there.seen > 0, each, np.nan).astype(float), at, order=1, mode="nearest")
            for each in (there.map_x, there.map_y)
        )
        valid = np.isfinite(x) & (back.seen[v, u] > 0)
        assert valid.mean() > 0.4
        assert np.hypot(x - u, y - v)[valid].max() <= 0.005  # px; bilinear, and float32


@pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
@pytest.mark.parametrize("readout", ["top-to-bottom", "right-to-left"])
@all_models
def test_inverse_is_where_undistort_points_sends_the_pixels(model, readout, dist):
    camera = make_camera(dist, readout)
    inverse = RemapGrid.from_camera(camera, MOTION, model).inverse()
    u, v = (each.ravel() for each in np.meshgrid(np.arange(0, W, 3), np.arange(0, H, 3)))
    known = inverse.seen[v, u] > 0
    expected = undistort_points(np.column_stack([u, v]).astype(float), camera, MOTION, model, P=K)
    found = np.column_stack([inverse.map_x[v, u], inverse.map_y[v, u]])
    # px; bilinear between pixels of a map whose slope changes by 1e-3 a pixel at most, and float32
    assert abs(found - expected)[known].max() <= 2e-3
    # it knows all that the rectified photo shows
    inner = (expected > 0.01).all(1) & (expected < [W - 1.01, H - 1.01]).all(1)
    assert known[inner].all()
    assert inner.mean() > 0.5


def test_inverse_knows_the_depth_of_its_grid():
    camera, motion = make_camera(LENS), RowMotion([0.05, 0.02, -0.03], [0.4, 0.1, 0.2])
    ground = Plane([0.1, 0.9, 0.5], 3.0)
    inverse = RemapGrid.from_camera(camera, motion, "constant-motion", depth=ground).inverse()
    known = inverse.seen > 0
    raw = np.argwhere(known)[:, ::-1].astype(float)
    expected = undistort_points(raw, camera, motion, "constant-motion", P=K, depth=ground)
    found = np.column_stack([inverse.map_x[known], inverse.map_y[known]])
    smooth = raw[:, 1] > 200  # px; below the horizon, where the map has an edge
    assert abs(found - expected)[smooth].max() <= 5e-3  # bilinear, and float32
    assert smooth.sum() > 1e5


def test_inverse_of_a_fold_takes_one_of_the_two():
    x = np.tile(np.r_[np.arange(0, 8), np.arange(6, -1, -1)].astype(np.float32), (4, 1))
    grid = RemapGrid(x, np.tile(np.arange(4, dtype=np.float32)[:, None], (1, 15)), 8, 4)
    np.testing.assert_array_equal(grid.inverse().map_x, np.tile(np.arange(8), (4, 1)))


def test_grid_is_applied_as_rectify_does(rng):
    camera, photo = make_camera(LENS), np.rint(255 * smooth_photo(rng)).astype(np.uint8)
    new = Camera(500, 300, [[500, 0, 250], [0, 510, 140], [0, 0, 1]])
    grid = RemapGrid.from_camera(camera, MOTION, new_camera=new)
    expected, mask = rectify(photo, camera, MOTION, new_camera=new, interpolation="linear")
    for jobs in (1, 3):
        found, seen = grid.apply(photo, "linear", jobs)
        np.testing.assert_array_equal(seen, mask)
        assert abs(found.astype(int) - expected).max() <= 1
    with pytest.raises(InputError, match="photo has 640x300 pixels"):
        grid.apply(photo[:300])
    with pytest.raises(InputError, match="interpolation='area'"):
        grid.apply(photo, "area")


@pytest.mark.parametrize(
    ("new", "says"),
    [(make_camera(LENS), "lens distortion"), (K, "new_camera: expected"), (0, "new_camera: expected")],
    ids=["lens", "matrix", "zero"],
)
def test_a_grid_is_of_a_pinhole_camera(new, says):
    for use in (RemapGrid.from_camera, partial(rectify, np.zeros((H, W), np.uint8)), largest_shift_px):
        with pytest.raises(InputError, match=says):
            use(make_camera(), MOTION, new_camera=new)


@pytest.mark.parametrize(
    ("x", "y", "says"),
    [
        (np.zeros((3, 4)), np.zeros((4, 3)), "expected the same"),
        (np.full((3, 4), np.nan), np.zeros((3, 4)), "map_x holds NaN"),
        (np.zeros(3), np.zeros(3), r"map_x\.shape"),
        (np.zeros((0, 4)), np.zeros((0, 4)), "expected the same"),
    ],
)
def test_impossible_grids_are_refused(x, y, says):
    with pytest.raises(InputError, match=says):
        RemapGrid(x, y, 5, 5)
    with pytest.raises(InputError, match="source_width=0"):
        RemapGrid(np.zeros((2, 2)), np.zeros((2, 2)), 0, 5)


# ---------------------------------------------------------------------------------------------- files


@pytest.fixture
def grid():
    """A grid with pixels that nothing answers, of another size than its source."""
    camera = Camera(W, H, K, [-0.6, 0, 0, 0])
    return RemapGrid.from_camera(camera, MOTION, new_camera=Camera(300, 200, [[120, 0, 150], [0, 120, 100], [0, 0, 1]]))


@pytest.mark.parametrize("kind", ["npz", "exr", "stmap"])
def test_grid_comes_back_from_its_file(kind, grid, tmp_path):
    assert grid.map_x.min() < -1e5
    for each in (grid, grid.inverse()):
        path = tmp_path / f"grid.{'npz' if kind == 'npz' else 'exr'}"
        each.save(path, kind)
        back = RemapGrid.load(path)
        assert (back.source_width, back.source_height) == (each.source_width, each.source_height)
        tolerance = 1e-3 if kind == "stmap" else 0  # px; float32 of numbers to 1 times the size
        known = each.map_x > -1e5
        np.testing.assert_array_equal(back.map_x > -1e5, known)
        for found, expected in ((back.map_x, each.map_x), (back.map_y, each.map_y)):
            np.testing.assert_allclose(found[known], expected[known], rtol=0, atol=tolerance)
        assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("kind", ["exr", "stmap"])
def test_another_reader_of_exr_remaps_alike(kind, grid, tmp_path, rng):
    OpenEXR = pytest.importorskip("OpenEXR")
    grid.save(tmp_path / "grid.exr", kind)
    with OpenEXR.File(str(tmp_path / "grid.exr"), separate_channels=True) as file:
        r, g, b = (file.channels()[name].pixels for name in "RGB")
    assert r.dtype == np.float32
    x, y = r, g
    if kind == "stmap":  # the corner of the source is 0, 0, below on the left; centres are half a pixel in
        x, y = r.astype(float) * W - 0.5, H - 0.5 - g.astype(float) * H
    seen = grid.seen > 0
    np.testing.assert_array_equal(b > 0, seen)
    assert abs(x - grid.map_x)[seen].max() <= 1e-3
    assert abs(y - grid.map_y)[seen].max() <= 1e-3
    assert not ((x >= 0) & (x <= W - 1) & (y >= 0) & (y <= H - 1))[~seen].any()


def test_st_maps_of_others_need_the_size_of_their_source(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    u, v = np.meshgrid(np.arange(40), np.arange(30))
    channels = {"R": ((u + 0.5) / 40).astype(np.float32), "G": (1 - (v + 0.5) / 30).astype(np.float32)}
    channels["R"][0, 0] = np.nan
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(tmp_path / "identity.exr"))
    with pytest.raises(InputError, match="give source_size"):
        RemapGrid.load(tmp_path / "identity.exr")
    grid = RemapGrid.load(tmp_path / "identity.exr", (40, 30))
    image = np.arange(1200, dtype=np.uint16).reshape(30, 40)
    found, seen = grid.apply(image, "nearest")
    assert seen[0, 0] == 0
    np.testing.assert_array_equal(found[seen > 0], image[seen > 0])
    assert (seen > 0).sum() == 1199


def test_files_that_are_no_grids_are_refused(grid, tmp_path):
    for name in ("a.npz", "a.exr"):
        with pytest.raises(FileError, match="is no file"):
            RemapGrid.load(tmp_path / name)
        (tmp_path / name).write_bytes(b"PK\x03\x04 no grid")
        with pytest.raises(FormatError, match=name):
            RemapGrid.load(tmp_path / name)
    np.savez(tmp_path / "b.npz", map_x=np.zeros((2, 2)))
    with pytest.raises(FormatError, match="lacks map_y"):
        RemapGrid.load(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", map_x=np.array([object()]), map_y=np.zeros(1), source_size=np.ones(2, int))
    with pytest.raises(FormatError, match=r"c\.npz"):
        RemapGrid.load(tmp_path / "c.npz")
    with pytest.raises(InputError, match="kind='tiff', expected one of npz, exr, stmap"):
        grid.save(tmp_path / "d.npz", "tiff")
    with pytest.raises(InputError, match=r"has the ending \.exr"):
        grid.save(tmp_path / "d.npz", "stmap")
    for kind, name in (("npz", "d.npz"), ("exr", "d.exr")):
        with pytest.raises(FileError, match="cannot be written"):
            grid.save(tmp_path / "missing" / name, kind)
    assert not (tmp_path / "d.npz").exists()
