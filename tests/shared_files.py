"""A file system for `fsspec` that several processes see: a folder of this machine, with renaming as on SMB."""

from __future__ import annotations

import fsspec
from fsspec.implementations.local import LocalFileSystem


class SharedFileSystem(LocalFileSystem):
    """`shared:///folder`; nothing is renamed onto what is there."""

    protocol = "shared"

    @classmethod
    def _strip_protocol(cls, path):
        return LocalFileSystem._strip_protocol(str(path).removeprefix("shared://"))

    def mv(self, path1, path2, **kwargs):
        if self.exists(path2):
            raise FileExistsError(path2)
        super().mv(path1, path2, **kwargs)


fsspec.register_implementation("shared", SharedFileSystem, clobber=True)
