"""Rectification of photos, one or a folder of them: their geometry, the files, the workers."""

from .folder import rectify_folder
from .rectify_options import RectifyOptions
from .workers import use_threads

__all__ = ["RectifyOptions", "rectify_folder", "use_threads"]
