"""Structure from motion around pycolmap: features, matching, mapping, re-triangulation."""

from .database import MatchedPhotos, kept_log_level
from .features import Features, detect_features
from .imported import matched_of_database
from .mapping import map_photos
from .matching import match_photos
from .retriangulation import retriangulate

__all__ = [
    "Features",
    "MatchedPhotos",
    "detect_features",
    "kept_log_level",
    "map_photos",
    "match_photos",
    "matched_of_database",
    "retriangulate",
]
