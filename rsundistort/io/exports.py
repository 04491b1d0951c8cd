"""The programs that a solution can be written for besides COLMAP and nerfstudio: a folder in OUT for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from ..errors import InputError
from .export_scene import ExportScene
from .metashape import write_metashape
from .ncore import write_ncore
from .nuke import write_nuke
from .opensfm import check_opensfm_names, write_opensfm
from .opf import write_opf, write_rectified_opf

__all__ = ["EXPORTS", "check_exports"]


@dataclass(frozen=True)
class Export:
    """How one of them is written.

    Attributes
    ----------
    write : callable
        Of a folder and a scene; returns what the format has no room for, with the error that this leaves, or "".
    files : tuple of str
        What it writes into the folder, as far as it is the same for all photos.
    module, extra : str
        What it needs, and the extra that brings it; empty where that is nothing.
    """

    write: Callable[[Path, ExportScene], str]
    files: tuple[str, ...]
    module: str = ""
    extra: str = ""


_OPF = ("project.opf", "camera_list.json", "input_cameras.json", "calibration/calibrated_cameras.json")

#: By the name of the option and of the folder in OUT.
EXPORTS: dict[str, Export] = {
    "metashape": Export(write_metashape, ("cameras.xml",)),
    "ncore": Export(write_ncore, (), "ncore.data.v4", "ncore"),
    "nuke": Export(write_nuke, ("camera.nk", "camera.chan")),
    "opensfm": Export(write_opensfm, ("reconstruction.json", "camera_models.json", "tracks.csv", "image_list.txt")),
    "opf": Export(write_opf, _OPF, "pyopf", "opf"),
    "opf-rectified": Export(write_rectified_opf, _OPF, "pyopf", "opf"),
}


def check_exports(exports: Sequence[str], names: Sequence[str] = ()) -> None:
    """Refuse, before any work, what there is no writer for, what it needs and is not here, or photos it confuses."""
    for name in exports:
        if name not in EXPORTS:
            raise InputError(f"export={name!r}, expected one of {', '.join(EXPORTS)}")
        if module := EXPORTS[name].module:
            extra = EXPORTS[name].extra
            try:
                import_module(module)  # some libraries are installed without what they need
            except ImportError as error:
                raise InputError(
                    f'--export {name} needs the extra {extra}: pip install "rsundistort[{extra}]" ({error})'
                ) from error
    if "opensfm" in exports:
        check_opensfm_names(list(names))
