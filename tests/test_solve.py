"""`solve`: COLMAP models in, motions and the model without shutter out."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
import pycolmap
import pytest
from make_photos import exif_block, save_png, texture
from scipy.spatial.transform import Rotation

import rsundistort as rs
from rsundistort.colmap.measured_model import colmap_model_of, read_colmap_model, surviving_points
from rsundistort.errors import FileError, FormatError, InputError, RsUndistortError
from rsundistort.evaluation import pose_errors
from rsundistort.synthetic import project_rows

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT, F = 640, 480, 500.0
NAMES = ["walk/0007.png", "walk/0001.png", "b.png", "a.png", "c/d/e.png", "f.png"]
OPTIONS = rs.SolveOptions(shutter_model="rotation", readout="top-to-bottom", refine=())
LENSES = {
    "PINHOLE": ([F, F, 320.5, 240.5], [], "pinhole"),
    "SIMPLE_RADIAL": ([F, 320.5, 240.5, -0.08], [-0.08, 0, 0, 0], "pinhole"),
    "OPENCV": ([F, F, 320.5, 240.5, -0.1, 0.02, 1e-3, -5e-4], [-0.1, 0.02, 1e-3, -5e-4], "pinhole"),
    "OPENCV_FISHEYE": ([F, F, 320.5, 240.5, 0.02, -0.01, 0, 0], [0.02, -0.01, 0, 0], "fisheye"),
}


@dataclass
class Scene:
    """A model as COLMAP would have made it of photos with a shutter, and the truth."""

    model: pycolmap.Reconstruction
    R_cw: np.ndarray
    center_w: np.ndarray
    phi: np.ndarray
    points_w: np.ndarray
    point_ids: np.ndarray


def make_scene(rng, lenses=("OPENCV",), num_points=160, noise_px=0.1, keypoints_beside=5):
    """Six photos from all around a cloud, rolled; ids with gaps, keypoints without points, an unregistered photo."""
    m = len(NAMES)
    points_w = rng.uniform(-1, 1, (num_points, 3))
    model = pycolmap.Reconstruction()
    cameras = []
    for k, lens in enumerate(lenses):
        params, dist, kind = LENSES[lens]
        colmap = pycolmap.Camera(model=lens, width=WIDTH, height=HEIGHT, params=params, camera_id=4 + 3 * k)
        model.add_camera_with_trivial_rig(colmap)
        cameras.append(rs.Camera(WIDTH, HEIGHT, [[F, 0, 320], [0, F, 240], [0, 0, 1]], dist, lens=kind))
    angle = np.linspace(0, 4.5, m)
    center_w = 3.2 * np.column_stack([np.sin(angle), 0.3 * np.cos(3 * angle), -np.cos(angle)])
    R_cw = np.empty((m, 3, 3))
    for i in range(m):
        z = -center_w[i] / np.linalg.norm(center_w[i])
        x = np.cross([0, 1, 0], z)
        x /= np.linalg.norm(x)
        R_cw[i] = Rotation.from_rotvec([0, 0, 0.4 * (-1) ** i * i / m]).as_matrix() @ np.array([x, np.cross(z, x), z])
    phi = rng.normal(0, 0.03, (m, 3))
    point_ids = 10 + 3 * np.arange(num_points)
    tracks = [pycolmap.Track() for _ in range(num_points)]
    for i, name in enumerate(NAMES):
        camera = cameras[i % len(lenses)]
        xy, valid = project_rows(points_w, R_cw[i], center_w[i], rs.RowMotion(phi[i]), camera)
        seen = np.flatnonzero(valid & (xy > 1).all(1) & (xy < [WIDTH - 2, HEIGHT - 2]).all(1))
        keypoints = np.vstack(
            [rng.uniform(0, 400, (keypoints_beside, 2)), xy[seen] + rng.normal(0, noise_px, (len(seen), 2))]
        )
        image = pycolmap.Image(
            name=name, keypoints=keypoints + 0.5, camera_id=4 + 3 * (i % len(lenses)), image_id=20 - 2 * i
        )
        R = Rotation.from_rotvec(rng.normal(0, 0.003, 3)).as_matrix() @ R_cw[i]
        center = center_w[i] + rng.normal(0, 0.003, 3)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([R, -R @ center])))
        for place, p in enumerate(seen):
            tracks[p].add_element(20 - 2 * i, keypoints_beside + place)
    for p, track in enumerate(tracks):
        if track.length() < 2:
            continue
        xyz = points_w[p] + rng.normal(0, 0.003, 3)
        point = pycolmap.Point3D(xyz=xyz, color=[p % 256, 7, 255 - p % 256], track=track)
        model.add_point3D_with_id(int(point_ids[p]), point)
        for element in track.elements:
            model.images[element.image_id].set_point3D_for_point2D(element.point2D_idx, int(point_ids[p]))
    return Scene(model, R_cw, center_w, phi, points_w, point_ids)


def save(model, folder, form="bin"):
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if form == "bin" else model.write_text)(folder)
    return folder


def save_photos(folder, names=NAMES, width=WIDTH, height=HEIGHT):
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        save_png(folder / name, texture(width, height, k))
    return folder


def phi_errors(solution, scene):
    """(m, 3) of phi, around the mean: the mean trades with the shape."""
    found = np.array([solution.image(name).motion.phi for name in NAMES])
    return found - scene.phi


def tracks_of(model):
    """Point id to the photos and pixels that see it."""
    return {
        point_id: sorted((model.images[e.image_id].name) for e in point.track.elements)
        for point_id, point in model.points3D.items()
    }


# ---------------------------------------------------------------- what comes out


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize(
    "lenses", [("SIMPLE_RADIAL",), ("OPENCV",), ("OPENCV_FISHEYE",), ("OPENCV", "SIMPLE_RADIAL", "OPENCV_FISHEYE")]
)
def test_models_round_trip(tmp_path, rng, form, lenses):
    scene = make_scene(rng, lenses)
    solution = rs.solve(save(scene.model, tmp_path / "model", form), tmp_path / "out", OPTIONS)
    assert np.abs(phi_errors(solution, scene)).max() < 2.5e-3
    assert {image.name for image in solution.registered} == set(NAMES)
    assert set(solution.cameras) == {str(4 + 3 * k) for k in range(len(lenses))}
    given, found = tracks_of(scene.model), tracks_of(pycolmap.Reconstruction(tmp_path / "out" / "sparse"))
    out = pycolmap.Reconstruction(tmp_path / "out" / "sparse")
    assert len(found) >= 0.95 * len(given)
    for point_id, names in found.items():
        assert set(names) <= set(given[point_id])
        assert out.points3D[point_id].color.tolist() == scene.model.points3D[point_id].color.tolist()
    assert {image.name: image.image_id for image in out.images.values()} == {
        image.name: image.image_id for image in scene.model.images.values()
    }
    assert {camera.model_name for camera in out.cameras.values()} == {"PINHOLE"}
    assert not (tmp_path / "out" / "images").exists()


def test_names_with_spaces_are_whole_in_text_too(tmp_path, rng):
    scene = make_scene(rng)
    for image in scene.model.images.values():
        image.name = f"two words/{image.image_id} of all.png"
    expected = {image.image_id: image.name for image in scene.model.images.values()}
    rs.solve(save(scene.model, tmp_path / "model", "txt"), tmp_path / "out", OPTIONS)
    found = pycolmap.Reconstruction(tmp_path / "out" / "sparse").images.values()
    assert {image.image_id: image.name for image in found} == expected


def test_what_comes_out_is_a_model_without_shutter(rng):
    scene = make_scene(rng, noise_px=0.05)
    out, solution = rs.solve(scene.model, options=OPTIONS)
    errors = [
        np.linalg.norm(image.project_point(out.points3D[p.point3D_id].xyz) - p.xy)
        for image in out.images.values()
        for p in image.points2D
        if p.has_point3D()
    ]
    assert np.median(errors) < 0.15
    truth = [
        rs.SolvedImage(n, "4", R, c, rs.RowMotion()) for n, R, c in zip(NAMES, scene.R_cw, scene.center_w, strict=True)
    ]
    true = replace(solution, images=tuple(truth))
    assert pose_errors(solution, true).rotation_deg.max() < 0.1
    # the given frame is kept, not replaced by one of ours
    assert np.abs(np.array([solution.image(n).center_w for n in NAMES]) - scene.center_w).max() < 0.05


def test_photos_are_rectified_into_their_sub_folders(tmp_path, rng):
    scene = make_scene(rng)
    photos = save_photos(tmp_path / "photos")
    solution = rs.solve(save(scene.model, tmp_path / "model"), tmp_path / "out", OPTIONS, images=photos)
    for image in solution.registered:
        written = cv2.imread(str(tmp_path / "out" / "images" / image.name))
        again, _ = rs.rectify(cv2.imread(str(photos / image.name)), solution.cameras["4"], image.motion)
        assert np.array_equal(written, again)
    assert (tmp_path / "out" / "masks" / "c/d/e.png").is_file()


def test_a_photo_that_a_track_holds_twice_counts_once(rng):
    scene = make_scene(rng)
    model = scene.model
    image = model.images[20]
    p = next(k for k, point in enumerate(image.points2D) if point.has_point3D())
    point_id = image.points2D[p].point3D_id
    beside = next(k for k, point in enumerate(image.points2D) if not point.has_point3D())
    model.add_observation(point_id, pycolmap.TrackElement(20, beside))
    given = colmap_model_of(model)
    obs = given.reconstruction.observations
    assert len(np.unique(obs.frame_idx * 10**6 + obs.point_idx)) == len(obs)
    at = given.point_ids[obs.point_idx] == point_id
    of_image = np.flatnonzero(at & (given.image_ids[obs.frame_idx] == 20))
    # of the two, the one that fits
    assert given.keypoint_idx[of_image].tolist() == [p]


def test_unregistered_photos_are_said_to_be(tmp_path, rng):
    scene = make_scene(rng, ("OPENCV", "OPENCV"))
    lost = NAMES[-1]
    image = next(image for image in scene.model.images.values() if image.name == lost)
    for k, point in enumerate(image.points2D):
        if point.has_point3D():
            scene.model.delete_observation(image.image_id, k)
    scene.model.deregister_frame(image.frame_id)
    image_of_lost = rs.solve(scene.model, options=OPTIONS)[1].image(lost)
    assert "not registered" in image_of_lost.reason
    assert image_of_lost.camera_id == "7"
    # the files of a model do not name them, the folder of photos does
    photos = save_photos(tmp_path / "photos")
    (photos / "notes.txt").write_text("no photo")
    solution = rs.solve(save(scene.model, tmp_path / "model"), tmp_path / "out", OPTIONS, images=photos)
    assert [image.name for image in solution.images if not image.registered] == [lost]
    assert "not registered" in solution.image(lost).reason


def test_points_go_on_in_the_new_ones_that_hold_most_of_them(rng):
    given = colmap_model_of(make_scene(rng).model).reconstruction
    # split the first track in two and join the next two
    obs = given.observations
    point = np.array(obs.point_idx)
    first = np.flatnonzero(point == 0)
    point[first[-1]] = given.num_points
    point[point == 2] = 1
    after = replace(
        given,
        points_w=np.vstack([given.points_w, given.points_w[:1]]),
        observations=replace(obs, point_idx=point),
    )
    survivors = surviving_points(given, after)
    assert survivors[0] == 0
    assert survivors[given.num_points] == -1
    assert survivors[1] in (1, 2)
    assert (survivors[3:-1] == np.arange(3, given.num_points)).all()


# ---------------------------------------------------------------- the database


def make_database(path, scene):
    """What COLMAP's matching would have written: all keypoints, and matches between all photos."""
    model = scene.model
    with pycolmap.Database.open(path) as db:
        for camera in model.cameras.values():
            db.write_camera(camera, use_camera_id=True)
        new = {}
        for image in sorted(model.images.values(), key=lambda image: image.name):
            copy = pycolmap.Image(name=image.name, camera_id=image.camera_id)
            new[image.image_id] = db.write_image(copy)
            db.write_keypoints(new[image.image_id], np.array([p.xy for p in image.points2D], np.float32))
        at = {
            (image.image_id, p.point3D_id): k
            for image in model.images.values()
            for k, p in enumerate(image.points2D)
            if p.has_point3D()
        }
        ids = sorted(new)
        for i, first in enumerate(ids):
            for second in ids[i + 1 :]:
                common = [p for (image, p) in at if image == first and (second, p) in at]
                matches = np.array([[at[first, p], at[second, p]] for p in common], np.uint32).reshape(-1, 2)
                db.write_matches(new[first], new[second], matches)
    return path


def as_floats(model):
    """A model whose keypoints are rounded as a database rounds them."""
    for image in model.images.values():
        for point in image.points2D:
            point.xy = np.asarray(point.xy, np.float32).astype(np.float64)
    return model


def test_measurements_that_colmap_threw_away_come_back(tmp_path, rng):
    scene = make_scene(rng, noise_px=0.1)
    as_floats(scene.model)
    database = make_database(tmp_path / "database.db", scene)
    before = database.read_bytes()
    whole = scene.model.compute_num_observations()
    for image in scene.model.images.values():
        for k, point in enumerate(image.points2D):
            if point.has_point3D() and rng.random() < 0.3:
                scene.model.delete_observation(image.image_id, k)
    cut = scene.model.compute_num_observations()
    assert cut < 0.75 * whole
    level = pycolmap.logging.minloglevel
    out, solution = rs.solve(scene.model, options=OPTIONS, database=database)
    assert pycolmap.logging.minloglevel == level
    assert out.compute_num_observations() >= 0.95 * whole
    assert np.abs(phi_errors(solution, scene)).max() < 2.5e-3
    assert len(set(out.point3D_ids()) & set(scene.model.point3D_ids())) >= 0.9 * scene.model.num_points3D()
    assert database.read_bytes() == before


@pytest.mark.parametrize("what", ["missing", "no database", "another's photos", "other keypoints", "no matches"])
def test_a_database_that_is_not_the_models_is_refused(tmp_path, rng, what):
    scene = make_scene(rng)
    as_floats(scene.model)
    path = tmp_path / "database.db"
    if what == "no database":
        path.write_bytes(b"not a database at all" * 100)
    elif what != "missing":
        make_database(path, scene)
        with pycolmap.Database.open(path) as db:
            image = db.read_all_images()[0]
            if what == "another's photos":
                image.name = "elsewhere.png"
                db.update_image(image)
            elif what == "other keypoints":
                db.update_keypoints(image.image_id, db.read_keypoints(image.image_id) + 1)
            else:
                db.clear_matches()
    with pytest.raises(RsUndistortError) as error:
        rs.solve(save(scene.model, tmp_path / "model"), tmp_path / "out", OPTIONS, database=path)
    assert "\n" not in str(error.value)
    assert "database.db" in str(error.value)
    assert path.exists() == (what != "missing")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- frames


def turned_model(scene, orientation_of):
    """The same model of photos that were rotated by their EXIF orientation before COLMAP looked at them."""
    given = colmap_model_of(scene.model)
    from rsundistort.colmap.rectified_model import ModelIds
    from rsundistort.model.orientation import orient_reconstruction

    rec = orient_reconstruction(given.reconstruction, orientation_of)
    ids = ModelIds(range(1, 1 + len(rec.cameras)), given.image_ids.tolist(), given.point_ids.tolist())
    model = pycolmap.Reconstruction()
    for key, camera in zip(ids.cameras, rec.cameras, strict=True):
        K = camera.K
        params = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *camera.dist]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=params, camera_id=int(key))
        )
    obs = rec.observations
    at = {}
    for i, name in enumerate(rec.image_names):
        mine = np.flatnonzero(obs.frame_idx == i)
        at |= {int(k): (ids.images[i], place) for place, k in enumerate(mine)}
        R = rec.R_cw[i]
        image = pycolmap.Image(
            name=name, keypoints=obs.xy_raw[mine] + 0.5, camera_id=int(rec.camera_idx[i]) + 1, image_id=ids.images[i]
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([R, -R @ rec.center_w[i]])))
    for p in range(rec.num_points):
        track = pycolmap.Track()
        for k in np.flatnonzero(obs.point_idx == p):
            track.add_element(*at[int(k)])
        model.add_point3D(rec.points_w[p], track)
    return model


def test_a_model_of_rotated_photos_is_rotated_back(tmp_path, rng):
    scene = make_scene(rng)
    photos = save_photos(tmp_path / "photos")
    for name in NAMES[:3]:
        block = exif_block(6)
        done, data = cv2.imencodeWithMetadata(
            ".png", cv2.imread(str(photos / name)), [cv2.IMAGE_METADATA_EXIF], [block]
        )
        assert done
        (photos / name).write_bytes(bytes(data))
    model = save(turned_model(scene, dict.fromkeys(NAMES[:3], 6)), tmp_path / "model")
    solution = rs.solve(model, tmp_path / "out", OPTIONS, images=photos)
    # the shutter runs over the rows of the sensor, whichever way people hold the camera
    assert np.abs(phi_errors(solution, scene)).max() < 2.5e-3
    assert "rotated" in solution.options["model"]["frame"]
    assert "3 of 6" in solution.options["model"]["frame"]


def test_photos_of_another_size_are_refused(tmp_path, rng):
    photos = save_photos(tmp_path / "photos", width=600, height=480)
    model = save(make_scene(rng).model, tmp_path / "model")
    with pytest.raises(InputError, match="600x480 pixels, its camera in the model 640x480"):
        rs.solve(model, tmp_path / "out", OPTIONS, images=photos)
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- Python


def test_threads_solve_side_by_side_and_nothing_global_changes(rng):
    scenes = [make_scene(rng), make_scene(rng, ("SIMPLE_RADIAL",))]
    alone = [rs.solve(scene.model, options=OPTIONS)[1] for scene in scenes]
    before = cv2.getNumThreads(), numba.get_num_threads(), np.geterr(), pycolmap.logging.minloglevel
    found = {}

    def work(k):
        found[k] = rs.solve(scenes[k].model, options=OPTIONS)[1]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert before == (cv2.getNumThreads(), numba.get_num_threads(), np.geterr(), pycolmap.logging.minloglevel)
    for k in range(2):
        for name in NAMES:
            assert np.allclose(found[k].image(name).motion.phi, alone[k].image(name).motion.phi, rtol=0, atol=1e-12)


def test_what_progress_raises_stops_the_work(tmp_path, rng):
    class Enough(Exception):
        pass

    def progress(stage, done, total):
        if stage.startswith("model sequence"):
            raise Enough

    scene = make_scene(rng)
    tracks = tracks_of(scene.model)
    with pytest.raises(Enough):
        rs.solve(scene.model, options=OPTIONS, progress=progress)
    assert tracks_of(scene.model) == tracks
    with pytest.raises(Enough):
        rs.solve(save(scene.model, tmp_path / "model"), tmp_path / "out", OPTIONS, progress=progress)
    assert not (tmp_path / "out").exists()


def test_options_in_the_second_place_still_work(rng):
    """Where `solve` of a reconstruction had them."""
    scene = make_scene(rng)
    with pytest.warns(DeprecationWarning, match=r"solve\(model, options=...\)"):
        _, former = rs.solve(scene.model, OPTIONS)
    assert former.shutter_model == OPTIONS.shutter_model
    _, present = rs.solve(scene.model, options=OPTIONS)
    assert np.allclose(former.image(NAMES[0]).motion.phi, present.image(NAMES[0]).motion.phi, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- bad input


def test_what_does_not_go_together_is_refused(tmp_path, rng):
    model = make_scene(rng).model
    folder = save(model, tmp_path / "model")
    with pytest.raises(InputError, match=f"out is missing; say which folder gets the outputs of {folder}"):
        rs.solve(folder)
    for options in ({"out": tmp_path / "out"}, {"images": tmp_path}):
        with pytest.raises(InputError, match="out and images are for a model in files"):
            rs.solve(model, **options)
    with pytest.raises(InputError, match=r"model is a builtins\.int, expected a folder, a file or a pycolmap"):
        rs.solve(20)
    for extra in ({"maps": "npz"}, {"also": [(tmp_path, "nearest")]}, {"masks": tmp_path}):
        with pytest.raises(InputError, match="maps, masks and other images are of rectified photos; give images"):
            rs.solve(folder, tmp_path / "out", rectify=rs.RectifyOptions(**extra))
    assert not (tmp_path / "out").exists()


def spoil_points(scene):
    scene.model.delete_all_points2D_and_points3D()


def spoil_pose(scene):
    image = scene.model.images[20]
    pose = np.array(image.cam_from_world().matrix())
    pose[0, 3] = np.nan
    scene.model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(pose)


def spoil_name(name):
    def spoil(scene):
        scene.model.images[20].name = name

    return spoil


def spoil_camera(scene):
    camera = scene.model.cameras[4]
    camera.model = pycolmap.CameraModelId.THIN_PRISM_FISHEYE
    camera.params = [F, F, 320, 240, 0, 0, 0, 0, 0, 0, 0.02, 0.01]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (spoil_points, "0 points"),
        (spoil_pose, "no number"),
        (spoil_name("../x.png"), "inside the folder"),
        (spoil_name("/x.png"), "inside the folder"),
        (spoil_camera, "camera 4 is THIN_PRISM_FISHEYE"),
    ],
)
def test_bad_models_are_refused_in_one_line(tmp_path, rng, spoil, says):
    scene = make_scene(rng)
    spoil(scene)
    model = save(scene.model, tmp_path / "model")
    with pytest.raises(RsUndistortError) as error:
        rs.solve(model, tmp_path / "out", OPTIONS)
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_rigs_of_several_sensors_are_refused(rng):
    scene = make_scene(rng, ("OPENCV", "SIMPLE_RADIAL"))
    rig = pycolmap.Rig(rig_id=77)
    ids = [camera.sensor_id for camera in scene.model.cameras.values()]
    rig.add_ref_sensor(ids[0])
    rig.add_sensor(ids[1], pycolmap.Rigid3d())
    scene.model.add_rig(rig)
    with pytest.raises(FormatError, match="rig 77 holds 2 sensors"):
        rs.solve(scene.model, options=OPTIONS)


def test_what_is_no_model_is_refused(tmp_path):
    (tmp_path / "model").mkdir()
    for path in (tmp_path / "model", tmp_path / "missing"):
        with pytest.raises(FileError) as error:
            read_colmap_model(path)
        assert "\n" not in str(error.value)


def test_photos_missing_on_disk_are_named(tmp_path, rng):
    photos = save_photos(tmp_path / "photos", NAMES[1:])
    with pytest.raises(InputError, match=NAMES[0]):
        rs.solve(save(make_scene(rng).model, tmp_path / "model"), tmp_path / "out", OPTIONS, images=photos)
    assert not (tmp_path / "out").exists()


def test_photos_that_were_rectified_before_are_refused(tmp_path, rng):
    photos, model = save_photos(tmp_path / "photos", NAMES), save(make_scene(rng).model, tmp_path / "model")
    rs.solve(model, tmp_path / "first", OPTIONS, images=photos)
    with pytest.raises(InputError, match=r"all photos were rectified already, by rsundistort .*; give the raw ones"):
        rs.solve(model, tmp_path / "out", OPTIONS, images=tmp_path / "first" / "images")
    with pytest.raises(InputError, match=r"shows the rectified photos of .*first, not those in .*photos; `rsundistort"):
        rs.solve(tmp_path / "first" / "sparse", tmp_path / "out", OPTIONS, images=photos)
    assert not (tmp_path / "out").exists()
