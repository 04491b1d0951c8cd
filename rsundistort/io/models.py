"""Models of other programs, recognised by their content."""

from __future__ import annotations

from pathlib import Path

from ..colmap.measured_model import ColmapModel, read_colmap_model
from ..errors import FormatError, InputError
from .json_text import read_json
from .openmvg import openmvg_model
from .opensfm import opensfm_model
from .opf import opf_model

__all__ = ["read_model"]


def read_model(path: Path) -> ColmapModel:
    """The model of a folder (COLMAP), or of a file: OpenMVG's sfm_data.json, OpenSfM's reconstruction.json, OPF.

    Raises
    ------
    FileError, FormatError
        When there is none, or one that cannot be taken.
    """
    path = Path(path)
    if not path.is_file():
        return read_colmap_model(path)
    if path.suffix.lower() == ".opf":
        return opf_model(path).once_a_photo()
    mend = (
        "give the folder of a COLMAP model, OpenMVG's sfm_data.json, OpenSfM's reconstruction.json, Metashape's "
        "cameras.xml or an OPF project"
    )
    try:
        value = read_json(path)
    except FormatError as error:
        raise FormatError(f"{path} is no model; {mend}") from error
    try:
        if isinstance(value, dict) and "sfm_data_version" in value:
            return openmvg_model(value, str(path)).once_a_photo()
        if isinstance(value, list) and value and isinstance(value[0], dict) and "shots" in value[0]:
            return opensfm_model(value, path).once_a_photo()
    except InputError as error:
        raise error if str(path) in str(error) else FormatError(f"{path}: {error}") from error
    raise FormatError(f"{path} is no model; {mend}")
