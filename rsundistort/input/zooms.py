"""Photos of another zoom, or of another camera, that their files do not tell apart."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..model import Camera
from ..model.focal_lengths import zooms
from .photo_cameras import GUESS_SIGMA, PhotoCameras

__all__ = ["cameras_by_zoom"]

# Photos of a focal length that no other camera has, at least: a single one may as well be misplaced.
_LEAST = 2


def cameras_by_zoom(
    cameras: PhotoCameras, names: Sequence[str], focal_px: Mapping[str, float]
) -> tuple[PhotoCameras, list[str]] | None:
    """The cameras of photos after those whose focal lengths lie apart got cameras of their own.

    Parameters
    ----------
    names : sequence of str
        All photos, in the order of the cameras.
    focal_px : mapping of photo name to float
        Focal lengths of photos with lenses that vary; those of others are not known.

    Returns
    -------
    cameras : PhotoCameras
        The most photos of each keep their camera, with the focal length found; the others are known no better than by
        EXIF.
    notes : list of str
        Which photos have another one, for people; None if none do.
    """
    values = np.array([focal_px.get(name, np.nan) for name in names])
    camera_idx, found, labels = cameras.camera_idx.copy(), [*cameras.cameras], [*cameras.labels]
    divided = [*range(len(found))]
    sigma, notes = [dict(each) for each in cameras.sigma or [{}] * len(found)], list[str]()
    for k in range(len(cameras.cameras)):
        mine = np.flatnonzero((cameras.camera_idx == k) & np.isfinite(values))
        most, *others = sorted((mine[part] for part in zooms(values[mine])), key=len, reverse=True) or [mine]
        alike = [j for j, label in enumerate(cameras.labels) if j != k and _origin(label) == _origin(labels[k])]
        for part in others:
            usual, focal = (float(np.median(values[each])) for each in (most, part))
            apart = {j: abs(np.log(focal / cameras.cameras[j].K[0, 0])) for j in alike}
            nearest = min(apart, key=apart.__getitem__, default=k)
            is_known = nearest != k and apart[nearest] < abs(np.log(focal / usual))
            if is_known:
                camera_idx[part] = nearest
            elif len(part) < _LEAST:
                continue
            else:
                camera_idx[part] = len(found)
                divided.append(k)
                found.append(_with_focal(cameras.cameras[k], focal))
                labels.append(f"{labels[k]}-f{focal:.0f}")
                sigma.append(dict(GUESS_SIGMA) if cameras.calibrated else {})
            found[k] = _with_focal(cameras.cameras[k], usual)
            have = f"{len(part)} of {len(mine)} photos of {labels[k]} {'has' if len(part) == 1 else 'have'}"
            notes.append(
                f"{have} another focal length than the others, of about {focal:.0f} px in place of {usual:.0f} "
                f"({', '.join(names[i] for i in sorted(part.tolist()))}): another zoom, or another camera; solved as "
                "of another one"
            )
    if not notes:
        return None
    return replace(
        cameras, cameras=tuple(found), labels=tuple(labels), camera_idx=camera_idx, sigma=sigma,
        readout_specified=tuple(cameras.readout_specified[k] for k in divided),
        without_focal=[k for k, old in enumerate(divided) if old in cameras.without_focal],
    ), notes  # fmt: skip


def _origin(label: str) -> str:
    """The label of the camera that one was divided from, or its own."""
    return re.sub(r"(-f\d+)+$", "", label)


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    """A camera with another focal length."""
    K = camera.K.copy()
    K[0, 0], K[1, 1] = focal_px, focal_px * camera.K[1, 1] / camera.K[0, 0]
    return replace(camera, K=K)
