"""Known truth: a ray caster for rolling-shutter scenes, and real photos warped; no function shared with the kernels."""

from .recipe import Recipe, View, load_recipe, look_at
from .render import line_poses, pixel_rays, render_scene, render_view, rs_shift_px
from .scene import Light, Opening, Patch, Scene, box, wall
from .textures import Texture
from .warp import random_phi, warp_photo

__all__ = [
    "Light",
    "Opening",
    "Patch",
    "Recipe",
    "Scene",
    "Texture",
    "View",
    "box",
    "line_poses",
    "load_recipe",
    "look_at",
    "pixel_rays",
    "random_phi",
    "render_scene",
    "render_view",
    "rs_shift_px",
    "wall",
    "warp_photo",
]
