"""The folder of `colmap image_undistorter`, in which COLMAP's dense stereo works."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

__all__ = ["write_colmap_workspace"]

#: As many photos does COLMAP choose by itself to compare each with.
_NUM_SOURCES = 20

_PRODUCTS = ("depth_maps", "normal_maps", "consistency_graphs")

# to the byte what COLMAP writes: people have patches for it
_SCRIPT = r"""# You must set $COLMAP_EXE_PATH to 
# the directory containing the COLMAP executables.
$COLMAP_EXE_PATH/colmap patch_match_stereo \
  --workspace_path "." \
  --workspace_format COLMAP \
  --PatchMatchStereo.max_image_size 2000 \
  --PatchMatchStereo.geom_consistency {consistency}
$COLMAP_EXE_PATH/colmap stereo_fusion \
  --workspace_path "." \
  --workspace_format COLMAP \
  --input_type {kind} \
  --output_path "./fused.ply" \
$COLMAP_EXE_PATH/colmap poisson_mesher \
  --input_path "./fused.ply" \
  --output_path "./meshed-poisson.ply" \
$COLMAP_EXE_PATH/colmap delaunay_mesher \
  --input_path "./" \
  --input_type dense \
  --output_path "./meshed-delaunay.ply" \
"""  # noqa: W291


def write_colmap_workspace(folder: Path, names: Sequence[str]) -> None:
    """Write what COLMAP's dense stereo needs beside `images/` and `sparse/`: `stereo/`, and the scripts that run it.

    The names are those of the photos of the model, by their ids.
    """
    stereo = folder / "stereo"
    for product in _PRODUCTS:
        # COLMAP makes no folders when it writes depth maps
        for within in {PurePosixPath(name).parent for name in names} | {PurePosixPath()}:
            (stereo / product / within).mkdir(parents=True, exist_ok=True)
    sources = (f"{name}\n__auto__, {_NUM_SOURCES}\n" for name in names)
    _write(stereo / "patch-match.cfg", "".join(sources))
    _write(stereo / "fusion.cfg", "".join(f"{name}\n" for name in names))
    for kind, consistency in (("geometric", "true"), ("photometric", "false")):
        _write(folder / f"run-colmap-{kind}.sh", _SCRIPT.format(kind=kind, consistency=consistency))


def _write(path: Path, text: str) -> None:
    path.write_bytes(text.encode())  # a shell refuses line ends of Windows
