# SPDX-License-Identifier: Apache-2.0
"""Files by path or URL, through fsspec: local folders, s3://, http(s):// and whatever else is installed for it."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from shared.config import UserError
from shared.ros_map import replace_file
from zenav.batch.cluster_extra import require_extra

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

ENDINGS = ".mcap", ".bag", ".log", ".log.gz"
"""Of the recordings and logs that a folder is searched for."""
BLOCK = 1 << 20  # bytes that are hashed at a time
STORE_LIBRARIES = ("botocore", "aiobotocore", "aiohttp", "gcsfs")  # their errors are of no common type
REMOTE_ERRORS = (OSError, ValueError, ImportError)


class StoredLog(NamedTuple):
    """A recording or log. size: bytes.  tag: changes with the content (an etag), empty where the store has none.

    changed: when, in the store's words; empty where it does not say.
    """

    url: str
    size: int
    tag: str
    changed: str = ""


def file_system(url: str, **options: Any) -> tuple["AbstractFileSystem", str]:
    """The file system of a URL, and the path in it. Raises UserError where it has none, or it lacks its package.

    options: of that kind of file system.
    """
    require_extra("upload")
    import fsspec

    if "://" in url:
        options["use_listings_cache"] = False  # another process may have written meanwhile
    try:
        system, path = fsspec.core.url_to_fs(url, **options)
    except REMOTE_ERRORS as error:
        raise UserError(f"{url} cannot be opened: {error}", "a path, or a URL like s3://bucket/folder") from None
    return system, str(path)


@contextmanager
def errors_of(url: str) -> Iterator[None]:
    """An error of a store becomes a UserError that names the URL."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"there is no {url}", "give a path or URL of recordings, in quotes if it has a *") from None
    except PermissionError as error:
        raise UserError(f"{url}: {error or 'access is denied'}", "check the credentials in the environment") from None
    except REMOTE_ERRORS as error:
        raise UserError(f"{url}: {error}", "check the address and the network") from None
    except Exception as error:
        if not type(error).__module__.startswith(STORE_LIBRARIES):
            raise
        raise UserError(f"{url}: {error}", "check credentials, address and network") from None


def sources(patterns: list[str]) -> list[StoredLog]:
    """The recordings that paths, URLs and their globs name, in order, each once; a folder is all recordings below it.

    Raises UserError where a pattern names none.
    """
    found: dict[str, StoredLog] = {}
    for pattern in patterns:
        system, path = file_system(pattern)
        with errors_of(pattern):
            rows = list(_matching(system, path))
        if not rows:
            raise UserError(f"{pattern} names no recording", f"a folder is searched for *{', *'.join(ENDINGS)}")
        for row in rows:
            source = _source(system, row)
            found.setdefault(source.url, source)
    return [found[url] for url in sorted(found)]


def _matching(system: "AbstractFileSystem", path: str) -> Iterator[dict[str, Any]]:
    if any(sign in path for sign in "*?[") and not system.exists(path):
        yield from (row for row in system.glob(path, detail=True).values() if row["type"] == "file")
        return
    info = system.info(path)
    if info["type"] == "file":
        yield info
        return
    rows = system.find(path, detail=True).values()
    yield from (row for row in rows if str(row["name"]).endswith(ENDINGS))


def _source(system: "AbstractFileSystem", row: dict[str, Any]) -> StoredLog:
    tag = row.get("ETag") or row.get("etag") or row.get("md5Hash") or ""
    changed = str(row.get("mtime") or row.get("LastModified") or "")
    return StoredLog(str(system.unstrip_protocol(row["name"])), int(row.get("size") or 0), str(tag).strip('"'), changed)


def content_tag(source: StoredLog) -> str:
    """What a result's key has of its input: the store's tag, or the SHA-256 of the content. Raises UserError."""
    if source.tag:
        return f"{source.tag} {source.size}"
    system, path = file_system(source.url)
    digest = hashlib.sha256()
    with errors_of(source.url), system.open(path, "rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()


def content_version(source: StoredLog) -> str:
    """Text that changes with the content of a recording: size, and the store's tag or time of change."""
    return f"{source.size} {source.tag or source.changed}"


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """The file on this computer: itself, or a copy that exists within the block. Raises UserError."""
    system, path = file_system(url)
    if _is_local(system):
        yield Path(path)
        return
    with TemporaryDirectory(prefix="zenav-") as folder:
        copy = Path(folder) / path.rstrip("/").rsplit("/", 1)[-1]
        with errors_of(url):
            system.get_file(path, str(copy))
        yield copy


class Folder:
    """A folder by path or URL, in which names are written whole or not at all."""

    def __init__(self, url: str, **options: Any) -> None:
        self.system, self.path = file_system(url, **options)
        self.is_local = _is_local(self.system)
        if self.is_local:
            self.path = os.path.abspath(self.path)
        self.url = str(self.system.unstrip_protocol(self.path))

    def write(self, name: str, content: bytes) -> None:
        """Replaces a file. Raises UserError."""
        with errors_of(f"{self.url}/{name}"):
            if self.is_local:
                path = Path(self.path) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                replace_file(path, content)
            else:
                self.system.pipe_file(f"{self.path}/{name}", content)

    def read(self, name: str) -> bytes | None:
        """A file's content, None where there is none. Raises UserError."""
        with errors_of(f"{self.url}/{name}"):
            try:
                return bytes(self.system.cat_file(f"{self.path}/{name}"))
            except FileNotFoundError:
                return None

    def read_all(self, names: list[str]) -> dict[str, bytes]:
        """The content of files, read together; those that are gone are left out. Raises UserError."""
        paths = {f"{self.path}/{name}": name for name in names}
        with errors_of(self.url):
            found = self.system.cat_ranges(list(paths), None, None, on_error="return")  # cat takes [ for a glob
            contents = {}
            for path, content in zip(paths, found, strict=True):
                if isinstance(content, bytes):
                    contents[paths[path]] = content
                elif not isinstance(content, FileNotFoundError):
                    raise content
        return contents

    def names(self, folder: str) -> dict[str, int]:
        """Names below a folder of this one, with that folder, and sizes in bytes. Raises UserError."""
        with errors_of(self.url):
            try:
                rows = self.system.ls(f"{self.path}/{folder}", detail=True)
            except FileNotFoundError:
                return {}
        return {
            f"{folder}/{str(row['name']).rsplit('/', 1)[-1]}": int(row.get("size") or 0)
            for row in rows
            if row["type"] == "file"
        }

    def remove(self, names: list[str]) -> None:
        """Removes files; those that are gone already do not matter. Raises UserError."""
        with errors_of(self.url):
            for name in names:
                with suppress(FileNotFoundError):
                    self.system.rm_file(f"{self.path}/{name}")

    def source(self, name: str) -> StoredLog:
        """What the store says of a file. Raises UserError."""
        with errors_of(f"{self.url}/{name}"):
            return _source(self.system, self.system.info(f"{self.path}/{name}"))


def _is_local(system: "AbstractFileSystem") -> bool:
    return "file" in ((system.protocol,) if isinstance(system.protocol, str) else system.protocol)
