"""Structure from motion around pycolmap: features, pairs, matching, mapping, re-triangulation."""

from .affine_features import detect_affine_features
from .alignment import PatchPlaces, PatchSource, align_tracks, allowed_patches, cut_patches
from .connected import LEAST_MEASUREMENTS, LEAST_TIES, connected_photos, firmly_connected, other_scenes
from .contradiction import contradicting_photos
from .database import MatchedPhotos
from .epipolar import read_num_verified
from .features import (
    DETECTION_MEGAPIXELS,
    SIFT_PX,
    Features,
    ReducedPhoto,
    detect_features,
    detection_bytes,
    features_of_both,
    grey_8_bit,
    reduce_photo,
)
from .focal_length import USUAL_FOCAL, estimate_focal_length
from .imported import matched_of_database
from .mapping import map_photos
from .matching import match_photos
from .motion_averaging import map_without_motions
from .pairs import choose_pairs, global_descriptors
from .registration import register_photos
from .retriangulation import retriangulate
from .scale_breaks import photos_beside_breaks
from .sharpness import edge_width_px
from .sides import carried_along
from .verification import verify_with_shutter

__all__ = [
    "DETECTION_MEGAPIXELS",
    "LEAST_MEASUREMENTS",
    "LEAST_TIES",
    "SIFT_PX",
    "USUAL_FOCAL",
    "Features",
    "MatchedPhotos",
    "PatchPlaces",
    "PatchSource",
    "ReducedPhoto",
    "align_tracks",
    "allowed_patches",
    "carried_along",
    "choose_pairs",
    "connected_photos",
    "contradicting_photos",
    "cut_patches",
    "detect_affine_features",
    "detect_features",
    "detection_bytes",
    "edge_width_px",
    "estimate_focal_length",
    "features_of_both",
    "firmly_connected",
    "global_descriptors",
    "grey_8_bit",
    "map_photos",
    "map_without_motions",
    "match_photos",
    "matched_of_database",
    "other_scenes",
    "photos_beside_breaks",
    "read_num_verified",
    "reduce_photo",
    "register_photos",
    "retriangulate",
    "verify_with_shutter",
]
