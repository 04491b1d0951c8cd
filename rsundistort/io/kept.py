"""What the stages of a run came to, kept beside its outputs until it ends: what a killed run goes on with."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .aside import written_aside

__all__ = ["Kept"]

_PACKAGE = __name__.partition(".")[0]


class Kept:
    """Values by name, in a hidden folder of the outputs; each is whole or not there.

    A value is made of numbers, texts, arrays, lists, tuples, mappings and dataclasses of this package, and comes back
    bit by bit. What cannot be read is taken for missing.

    Parameters
    ----------
    out : Path or None
        Folder of the outputs; None keeps nothing.
    key : str
        What the values depend on; those of another key are dropped.
    """

    NAME = ".rsundistort-kept"

    def __init__(self, out: Path | None = None, key: str = "") -> None:
        self._folder = None if out is None else out / self.NAME
        self._key = key

    def holds(self) -> bool:
        """Whether there are values of this key."""
        if self._folder is None or self._folder.is_symlink():
            return False
        with suppress(OSError, UnicodeDecodeError):
            return (self._folder / "key").read_text(encoding="utf-8") == self._key
        return False

    def begin(self) -> None:
        """Make room for values, and drop those of another key."""
        if self._folder is not None and not self.holds():
            self.drop()
            self._folder.mkdir()
            with written_aside(self._folder / "key") as aside:
                aside.write_text(self._key, encoding="utf-8")

    def drop(self) -> None:
        """Delete all values."""
        if self._folder is None:
            return
        if self._folder.is_symlink():
            self._folder.unlink()
        else:
            shutil.rmtree(self._folder, ignore_errors=True)

    def path(self, name: str) -> Path | None:
        """Where a value is, or is to be; None where nothing is kept."""
        # names of photos are longer, and of more letters, than every file system takes
        return None if self._folder is None else self._folder / f"{sha256(name.encode(errors='replace')).hexdigest()}"

    def get(self, name: str) -> Any:
        """A value, or None."""
        path = self.path(name)
        if path is None:
            return None
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as values:
                arrays = {key: values[key] for key in values.files}
            return _decoded(json.loads(arrays.pop("tree").tobytes()), arrays)
        except Exception:  # NumPy, zlib and what is decoded trip over damage in many ways; it is found anew
            return None

    def put(self, name: str, value: Any) -> None:
        """Keep a value."""
        path = self.path(name)
        if path is None:
            return
        arrays: dict[str, NDArray[Any]] = {}
        tree = _encoded(value, arrays, {})
        with written_aside(path) as aside, aside.open("wb") as file:
            np.savez(file, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8), **arrays)  # type: ignore[arg-type]

    def get_file(self, name: str, target: Path) -> bool:
        """Copy a file that is kept to a path; whether there is one."""
        path = self.path(name)
        if path is None or not path.is_file():
            return False
        shutil.copyfile(path, target)
        return True

    def put_file(self, name: str, source: Path) -> None:
        """Keep a copy of a file."""
        path = self.path(name)
        if path is not None:
            with written_aside(path) as aside:
                shutil.copyfile(source, aside)


def _encoded(value: Any, arrays: dict[str, NDArray[Any]], seen: dict[int, tuple[str, Any]]) -> Any:
    """A value as JSON has it, and its arrays."""
    if value is None or isinstance(value, bool | str) or type(value) in (int, float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if value.dtype.hasobject:
            raise InputError(f"an array of {value.dtype} cannot be kept")
        key, _ = seen.get(id(value), ("", None))
        if not key:
            key = f"a{len(arrays)}"
            seen[id(value)] = key, value  # as long as it is held, no other one has its id
            arrays[key] = np.asarray(value)
        return ["array", key, bool(value.flags.writeable)] if isinstance(value, np.ndarray) else ["number", key]
    if isinstance(value, Path):
        return ["path", str(value)]
    if isinstance(value, range):
        return ["range", [value.start, value.stop, value.step]]
    if isinstance(value, Mapping):
        return ["map", [[_encoded(part, arrays, seen) for part in item] for item in value.items()]]
    if is_dataclass(value) and not isinstance(value, type):
        parts = {each.name: _encoded(getattr(value, each.name), arrays, seen) for each in fields(value)}
        return ["object", type(value).__module__, type(value).__qualname__, parts]
    for kind in (tuple, list, set, frozenset):
        if isinstance(value, kind):
            items = [_encoded(each, arrays, seen) for each in (sorted(value) if "set" in kind.__name__ else value)]
            named = () if type(value) is kind else (type(value).__module__, type(value).__qualname__)
            return [kind.__name__, items, *named]
    raise InputError(f"a {type(value).__name__} cannot be kept")


def _decoded(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """The value of what `_encoded` gave."""
    if not isinstance(tree, list):
        return tree
    kind, first, *rest = tree
    if kind == "array":  # a view: of an array that several hold, some may not write
        array = arrays[first].view()
        array.flags.writeable = rest[0]  # kernels are compiled for either
        return array
    if kind == "number":
        return arrays[first][()]
    if kind == "path":
        return Path(first)
    if kind == "range":
        return range(*first)
    if kind == "map":
        return {_decoded(key, arrays): _decoded(value, arrays) for key, value in first}
    if kind == "object":
        name, parts = rest
        found = _class_of(first, name)
        value = object.__new__(found)
        for each in fields(found):
            object.__setattr__(value, each.name, _decoded(parts[each.name], arrays))
        return value
    items = [_decoded(each, arrays) for each in first]
    if rest:
        return _class_of(*rest)(*items)
    return {"tuple": tuple, "list": list, "set": set, "frozenset": frozenset}[kind](items)


def _class_of(module: str, name: str) -> Any:
    """A dataclass or a named tuple of this package; nothing else is made of what stands in a file."""
    if module.split(".")[0] != _PACKAGE or not name.isidentifier():
        raise ValueError(module)
    found = getattr(importlib.import_module(module), name)
    if not isinstance(found, type) or not (is_dataclass(found) or issubclass(found, tuple)):
        raise ValueError(name)
    return found
