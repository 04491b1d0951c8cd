"""Structure from motion around pycolmap: features, matching, mapping, re-triangulation."""

from .features import Features, detect_features
from .mapping import MatchedPhotos, map_photos, match_photos, retriangulate

__all__ = ["Features", "MatchedPhotos", "detect_features", "map_photos", "match_photos", "retriangulate"]
