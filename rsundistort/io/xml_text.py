"""XML as people hand it in: whatever is wrong with it is one error with one line, and nothing is fetched."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from ..errors import FormatError, file_errors

__all__ = ["parse_xml", "read_xml"]

# Deeper than any program nests; trees are walked by recursion.
_DEEPEST = 100


def parse_xml(data: bytes | str) -> ElementTree.Element:
    """The root of an XML text; a ValueError whose words are for people where it is none.

    A document type is refused: only there can entities be declared, which name other files or stand for more than any
    memory holds.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    depth = 0

    def refuse(*_: object) -> None:
        raise ValueError("it declares a document type, in which entities hide; remove its <!DOCTYPE ...>")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise ValueError(f"it is nested deeper than {_DEEPEST}")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError) as error:
        raise ValueError(str(error)) from error
    return builder.close()


def read_xml(path: Path | str) -> ElementTree.Element:
    """The root of an XML file, as `parse_xml` takes it.

    Raises
    ------
    FileError, FormatError
        When it cannot be read; when it is no XML, declares a document type, or is nested without end.
    """
    with file_errors(path):
        data = Path(path).read_bytes()
    try:
        return parse_xml(data)
    except ValueError as error:
        raise FormatError(f"{path} is no valid XML: {error}") from error
