"""Keypoints and matches of a scene, in a database, without pictures."""

from __future__ import annotations

import numpy as np

from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.sfm import Features, MatchedPhotos
from rsundistort.sfm.database import write_photos


def matched_scene(scene, rng, database, share_wrong):
    """All photos that show something together matched; wrong matches are not verified."""
    count = scene.num_images
    rows = scene.observations.by_photo(count)
    features = [
        Features(scene.observations.xy_raw[each], np.ones(len(each)), np.zeros((len(each), 128), np.uint8))
        for each in rows
    ]
    matched = MatchedPhotos(database, scene.image_names, features, scene.cameras, np.zeros(count, int), True, 0)
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(database) as db:
        write_photos(db, matched)
        for i in range(count):
            for j in range(i + 1, count):
                points = [scene.observations.point_idx[rows[k]] for k in (i, j)]
                both = np.intersect1d(*points)
                if len(both) == 0:
                    continue
                first, second = (np.searchsorted(each, both) for each in points)
                wrong = np.flatnonzero(rng.uniform(size=len(both)) < share_wrong)
                second[wrong] = rng.permutation(second[wrong])
                pairs = np.column_stack([first, second]).astype(np.uint32)
                db.write_matches(i + 1, j + 1, pairs)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = np.delete(pairs, wrong, axis=0)
                db.write_two_view_geometry(i + 1, j + 1, geometry)
    return matched
