"""Folders of photos and outputs: local ones, and those that `fsspec` knows by a URL."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.request import url2pathname

from ..errors import FileError, InputError
from .aside import write_aside

__all__ = [
    "File",
    "Place",
    "RemoteFile",
    "RemoteFolder",
    "absolute",
    "delete_in",
    "fetched",
    "files_in",
    "files_of",
    "local_place",
    "place_of",
    "sizes_under",
    "stamps_of",
    "text_in",
    "write_in",
]

# Stores of objects, which are put whole and lie in no folder that has to be made (making one could make a bucket).
_OBJECT_STORES = {"memory", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss", "oci", "cos", "obs", "tos"}
# What file systems call the version of a file, the surest first; without any of it nobody knows whether it changed.
_VERSIONS = (
    "ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated", "modified", "modificationTime",
    "client_modified", "created",
)  # fmt: skip


@dataclass(frozen=True)
class RemoteFolder:
    """A folder that `fsspec` knows by a URL; small, and sent to where its files are read and written.

    What a file system says of its troubles becomes a `FileError` of one line.

    Attributes
    ----------
    url : str
        Without a slash at its end.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def protocol(self) -> str:
        """Such as "s3"."""
        return self.url.partition("://")[0]

    def holds(self, other: RemoteFolder) -> bool:
        """Whether the other one is this folder, or in it."""
        (fs, root), (others, inside) = _open(self.url), _open(other.url)
        return bool(fs == others) and PurePosixPath(inside).is_relative_to(PurePosixPath(root))

    def listing(self, within: str = ".") -> dict[str, Mapping[str, Any]] | None:
        """Entries of the folder or a sub-folder by name, as the file system has them; None without such a folder.

        Stores of objects know no empty folders.
        """
        fs, root = _open(self.url)
        top = root if within == "." else f"{root}/{within}"
        with _troubles(f"{self.url} cannot be read"):
            fs.invalidate_cache()
            try:
                entries = fs.ls(top, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                return None
        # some stores keep an object that stands for the folder itself
        paths = {entry["name"].rstrip("/"): entry for entry in entries if entry["name"].rstrip("/") != top}
        return {path.rpartition("/")[2]: paths[path] for path in sorted(paths)}

    def sizes_under(self, within: Collection[str]) -> dict[str, int]:
        """Sizes of all files in these sub-folders, by path."""
        fs, root = _open(self.url)
        found: dict[str, int] = {}
        with _troubles(f"{self.url} cannot be read"):
            fs.invalidate_cache()
            for each in within:
                with suppress(FileNotFoundError):
                    entries = fs.find(f"{root}/{each}", detail=True)
                    found |= {path[len(root) + 1 :]: int(entry["size"]) for path, entry in entries.items()}
        return found

    def read(self, path: str) -> bytes:
        """The content of a file in it."""
        fs, root = _open(self.url)
        with _troubles(f"{self.url}/{path} cannot be read"):
            return bytes(fs.cat_file(f"{root}/{path}"))

    def write(self, path: str, data: bytes) -> None:
        """Put a file into it, whole or not at all."""
        fs, root = _open(self.url)
        target = f"{root}/{path}"
        with _troubles(f"{self.url}/{path} cannot be written"):
            if self.protocol in _OBJECT_STORES:
                fs.pipe_file(target, data)
                return
            folder = target.rpartition("/")[0]
            aside = f"{folder}/.{secrets.token_hex(8)}.partial"
            fs.makedirs(folder, exist_ok=True)
            try:
                fs.pipe_file(aside, data)
                try:
                    fs.mv(aside, target)
                except OSError:  # there are file systems that do not rename onto what is there
                    if not fs.exists(target):
                        raise
                    fs.rm_file(target)
                    fs.mv(aside, target)
            except BaseException:
                with suppress(Exception):
                    fs.rm_file(aside)
                raise

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files in it; what is not there is passed over."""
        fs, root = _open(self.url)
        for path in paths:
            with _troubles(f"{self.url}/{path} cannot be deleted"), suppress(FileNotFoundError):
                fs.rm_file(f"{root}/{path}")


@dataclass(frozen=True)
class RemoteFile:
    """A file of a remote folder.

    Attributes
    ----------
    version : str
        Another one when the file has changed; empty where that is not known.
    """

    folder: RemoteFolder
    path: str
    version: str = ""

    def __str__(self) -> str:
        return f"{self.folder}/{self.path}"

    @property
    def name(self) -> str:
        """The name without folders."""
        return PurePosixPath(self.path).name


#: What photos lie in, and their outputs.
Place = Path | RemoteFolder
File = Path | RemoteFile


def place_of(place: Place | str) -> Place:
    """A folder by its path or URL; a file:// URL is a path.

    Raises
    ------
    InputError
        When it is neither a path nor a URL, no file system is known for the URL, or its package is missing.
    """
    _check_is_place(place)
    if isinstance(place, str) and place.startswith(("file://", "local://")):
        place = Path(url2pathname(place.partition("://")[2]))
    if isinstance(place, str) and "://" in place:
        place = RemoteFolder(place.rstrip("/") if not place.endswith("://") else place)
        if ".." in place.url.split("/"):
            raise InputError(f"{place}: a URL must not have '..' in it")
        _open(place.url)
    return place if isinstance(place, RemoteFolder) else Path(place)


def local_place(place: Path | str) -> Path:
    """A path as it is, that of a file:// URL; other URLs are refused."""
    _check_is_place(place)
    if isinstance(place, Path):
        return place
    if "://" not in place:
        return Path(place)
    if not place.startswith(("file://", "local://")):
        raise InputError(
            f"{place} is a URL, and here a path is needed; URLs are taken by rectify, for photos, masks and outputs"
        )
    local = place_of(place)
    assert isinstance(local, Path)
    return local


def _check_is_place(place: object) -> None:
    if not isinstance(place, str | os.PathLike | RemoteFolder):
        raise InputError(f"a path or URL is needed, not {place!r:.60}")


def files_in(place: Place, within: str = ".") -> dict[str, File] | None:
    """Files in a folder or a sub-folder of it by their own names, sorted; None if there is no such folder.

    Links that lead nowhere are among them: reading one says so, and nothing is left out in silence.
    """
    if isinstance(place, RemoteFolder):
        listing = place.listing(within)
        if listing is None:
            return None
        path = PurePosixPath(within)
        return {
            name: RemoteFile(place, (path / name).as_posix(), _version(entry))
            for name, entry in listing.items()
            if entry["type"] == "file"
        }
    folder = place / within
    if not folder.is_dir():
        return None
    paths = sorted(folder.iterdir())
    return {path.name: path for path in paths if path.is_file() or (path.is_symlink() and not path.exists())}


def files_of(place: Place, paths: Sequence[str]) -> dict[str, File]:
    """The files of a folder that have these paths in it, whether they are there or not."""
    if isinstance(place, Path):
        return {path: place / path for path in paths}
    found: dict[str, File] = {}
    for within in sorted({PurePosixPath(path).parent for path in paths}):
        files = files_in(place, within.as_posix()) or {}
        found |= {(within / name).as_posix(): file for name, file in files.items()}
    return {path: found.get(path) or RemoteFile(place, path) for path in paths}


def absolute(place: Place) -> Place:
    """The same folder wherever it is looked at."""
    return place.absolute() if isinstance(place, Path) else place


def sizes_under(place: Place, within: Collection[str]) -> dict[str, int]:
    """Sizes of all files in these sub-folders of a folder, by path."""
    if isinstance(place, RemoteFolder):
        return place.sizes_under(within)
    paths = (path for each in within for path in (place / each).rglob("*") if not path.is_dir())
    return {path.relative_to(place).as_posix(): path.lstat().st_size for path in paths}


def stamps_of(place: Place, paths: Iterable[str]) -> dict[str, str]:
    """Of files of a folder that are there, their size and what shows that they changed; "" for links and folders."""
    if isinstance(place, RemoteFolder):
        listings: dict[str, Mapping[str, Any]] = {}
        found = {}
        for path in paths:
            within, _, name = path.rpartition("/")
            if within not in listings:
                listings[within] = place.listing(within or ".") or {}
            if (entry := listings[within].get(name)) is not None:
                found[path] = f"{entry['size']} {_version(entry)}" if entry["type"] == "file" else ""
        return found
    stamps = {}
    for path in paths:
        with suppress(FileNotFoundError, NotADirectoryError):
            facts = os.lstat(place / path)
            stamps[path] = f"{facts.st_size} {facts.st_mtime_ns}" if stat.S_ISREG(facts.st_mode) else ""
    return stamps


def text_in(place: Place, path: str) -> str:
    """The text of a file of a folder; empty if there is none."""
    if isinstance(place, RemoteFolder):
        within, _, name = path.rpartition("/")
        return place.read(path).decode(errors="replace") if name in (place.listing(within or ".") or {}) else ""
    file = place / path
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""


def write_in(place: Place, path: str, data: bytes) -> None:
    """Write a file of a folder, whole or not at all."""
    if isinstance(place, RemoteFolder):
        place.write(path, data)
    else:
        write_aside(place / path, data)


def delete_in(place: Place, paths: Iterable[str]) -> None:
    """Delete files of a folder; what is not there, or elsewhere by its name, is passed over."""
    if isinstance(place, RemoteFolder):
        place.delete(path for path in paths if ".." not in path.split("/"))
        return
    for path in paths:
        if (place / path).parent.resolve().is_relative_to(place.resolve()):
            (place / path).unlink(missing_ok=True)


def fetched(file: File, folder: Path) -> Path:
    """The path of a file; a remote one is copied into a folder, which is made if missing.

    Raises
    ------
    FileError
        When it cannot be read.
    """
    if isinstance(file, Path):
        return file
    folder.mkdir(parents=True, exist_ok=True)
    data = file.folder.read(file.path)
    (folder / file.name).write_bytes(data)
    return folder / file.name


def _version(entry: Mapping[str, Any]) -> str:
    version = next((entry[key] for key in _VERSIONS if entry.get(key)), None)
    return "" if version is None else f"{entry['size']} {version}"


def _open(url: str) -> tuple[Any, str]:
    """The file system of a URL, which `fsspec` keeps, and the path in it."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise InputError(f'{url}: URLs need fsspec; install it: pip install "rsundistort[dask]"') from error
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise InputError(f"{url}: a package is missing: {_line(error)}") from error
    except Exception as error:  # whatever the packages of file systems raise
        raise InputError(f"{url} cannot be opened: {_line(error)}") from error
    return fs, path.rstrip("/")


@contextmanager
def _troubles(what: str) -> Iterator[None]:
    """What goes wrong in a file system, in one line: their packages have errors of their own, not only OSError."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileError(f"{what}: no such file, folder or bucket") from error
    except PermissionError as error:
        raise FileError(f"{what}: no permission ({_line(error)})") from error
    except Exception as error:
        raise FileError(f"{what}: {_line(error)}") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
