"""Known truth: a ray caster for rolling-shutter scenes, and real photos warped; no function shared with the kernels."""

from .flight import look_at
from .measurements import project_rows
from .plausible import check_recipe
from .recipe import Recipe, View, load_recipe
from .render import add_noise, render_depth, render_view, rs_shift_px
from .true_points import TruePoints, true_points
from .unsteady import Vibration
from .warp import warp_photo

__all__ = [
    "Recipe",
    "TruePoints",
    "Vibration",
    "View",
    "add_noise",
    "check_recipe",
    "load_recipe",
    "look_at",
    "project_rows",
    "render_depth",
    "render_view",
    "rs_shift_px",
    "true_points",
    "warp_photo",
]
