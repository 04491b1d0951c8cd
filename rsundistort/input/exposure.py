"""Bound on the motion by the exposure time: a sharp photo did not move far during its exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..bundle import BundleOptions
from ..model import Reconstruction
from .load import LoadedPhotos

__all__ = ["bounded_by_exposure"]

# Readout time of cameras that the table lacks: full frames without a mechanical shutter take up to a tenth of a second.
_LONGEST_READOUT_S = 0.1


def bounded_by_exposure(
    options: BundleOptions, reconstruction: Reconstruction, photos: LoadedPhotos, readout_s: Mapping[int, float]
) -> BundleOptions:
    """Options whose priors on the motion are bounded by the exposure of each photo that was exposed for long.

    If all were, the prior standard deviations of all are bounded, too, by the photo that may have moved most.

    The content of a photo whose steepest edges are b pixels wide moved by about b at most during the exposure, so by b
    times readout / exposure during the readout: an angle of that over the focal length, or a translation of that times
    the distance of the scene over the focal length.

    Parameters
    ----------
    reconstruction : Reconstruction
        The registered photos, and the distance of the scene.
    photos : LoadedPhotos
        Their EXIF, and their sharpness.
    readout_s : mapping of camera to float
        Readout times that are known.
    """
    rec = reconstruction
    place = {name: k for k, name in enumerate(photos.names)}
    limits: dict[str, float] = {}
    for i, name in enumerate(rec.image_names):
        facts = photos.facts[place[name]]
        exposure_s, edge_px = facts.exposure_s, photos.edges_px[place[name]] if photos.edges_px else None
        # a flash lights for a thousandth of a second, however long the shutter is open
        if exposure_s is None or edge_px is None or facts.flash:
            continue
        readout = readout_s.get(int(rec.camera_idx[i]), _LONGEST_READOUT_S)
        limits[name] = edge_px / float(rec.camera(i).K[0, 0]) * readout / exposure_s
    if len(limits) < rec.num_images:
        return replace(options, phi_limits=limits)
    most = max(limits.values())
    velocity = most * rec.size / rec.baseline
    return replace(options, phi_limits=limits, phi_sigma_most=most, velocity_sigma_most=velocity)
