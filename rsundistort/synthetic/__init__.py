"""Known truth: a ray caster for rolling-shutter scenes, and real photos warped; no function shared with the kernels."""

from .flight import look_at
from .measurements import Measured, measure, project_rows
from .plausible import check_recipe
from .recipe import Noise, Recipe, View, load_recipe
from .render import add_noise, line_poses, pixel_rays, render_depth, render_view, rs_shift_px
from .scene import Light, Opening, Patch, Scene, box, wall
from .surfaces import height_field, mesh
from .textures import Texture
from .true_points import TruePoints, true_points
from .unsteady import RowTable, Vibration, read_row_tables
from .warp import random_phi, warp_photo

__all__ = [
    "Light",
    "Measured",
    "Noise",
    "Opening",
    "Patch",
    "Recipe",
    "RowTable",
    "Scene",
    "Texture",
    "TruePoints",
    "Vibration",
    "View",
    "add_noise",
    "box",
    "check_recipe",
    "height_field",
    "line_poses",
    "load_recipe",
    "look_at",
    "measure",
    "mesh",
    "pixel_rays",
    "project_rows",
    "random_phi",
    "read_row_tables",
    "render_depth",
    "render_view",
    "rs_shift_px",
    "true_points",
    "wall",
    "warp_photo",
]
