# SPDX-License-Identifier: Apache-2.0
"""Messages of a rosbag2 database that its reader refuses, or of which it would not read all.

Source: https://www.sqlite.org/fileformat.html
"""

import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

Message = tuple[str, str, int, bytes]
"""Topic, type, ns when it was recorded, and the message's bytes."""

HEADER = struct.Struct(">16xH10xI")  # the size of a page, and how many there are
MAX_HOLES = 200  # places at which a damaged database is tried again


def check(path: Path) -> None:
    """Raises ValueError where the file is not the whole database, which sqlite3 itself may not notice."""
    if (missing := _missing(path)) > 0:
        raise ValueError(f"its last {missing} bytes are missing")
    if _journal(path):
        raise ValueError("its recorder was killed: a part is still in the -wal file")


def rescue_messages(path: Path) -> tuple[Iterator[Message], list[str]]:
    """The messages, one by one, and what was lost, in words: complete when they are through."""
    lost: list[str] = []
    return _messages(path, lost), lost


def _messages(path: Path, lost: list[str]) -> Iterator[Message]:
    with tempfile.TemporaryDirectory() as folder:
        whole = path
        if _missing(path) > 0:
            lost.append(f"{_missing(path)} bytes of its end are missing")
            whole = _of_whole_pages(path, Path(folder) / path.name)
        how = "mode=ro" if _journal(path) else "mode=ro&immutable=1"
        with closing(sqlite3.connect(f"{whole.absolute().as_uri()}?{how}", uri=True)) as database:
            yield from _rows(database, lost)


def _rows(database: sqlite3.Connection, lost: list[str]) -> Iterator[Message]:
    """Rows in their order; where a page is damaged, those behind it."""
    database.text_factory = lambda text: text.decode(errors="replace")
    try:
        database.execute("PRAGMA writable_schema=ON")  # sqlite3 then opens a file that is shorter than its header says
        rows = database.execute("SELECT id, name, type FROM topics").fetchall()
    except sqlite3.Error as error:
        lost.append(f"its list of topics cannot be read: {error}")
        return
    topics = {id_: (str(name), str(type_)) for id_, name, type_ in rows}
    last, step, n_holes = -1, 1, 0
    while n_holes < MAX_HOLES:
        try:
            for id_, topic, received, data in database.execute(
                "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id", (last,)
            ):
                last, step = id_, 1
                if topic in topics and isinstance(data, bytes) and isinstance(received, int):
                    yield *topics[topic], received, data
            break
        except (sqlite3.Error, OverflowError):
            n_holes += 1
            last, step = last + step, min(step * 2, 1 << 40)
    if n_holes:
        lost.append("pages of the database are damaged or missing: rows are lost")


def _missing(path: Path) -> int:
    """Bytes that the file is shorter than its header says."""
    page, n_pages = _pages(path)
    return page * n_pages - path.stat().st_size


def _pages(path: Path) -> tuple[int, int]:
    """Bytes of a page, and how many pages there should be."""
    with path.open("rb") as file:
        page, n_pages = HEADER.unpack(file.read(HEADER.size).ljust(HEADER.size, b"\0"))
    return 65536 if page <= 1 else page, max(n_pages, 1)


def _journal(path: Path) -> bool:
    """Whether what was not brought into the file yet stands beside it."""
    journal = path.with_name(path.name + "-wal")
    return journal.exists() and journal.stat().st_size > 0


def _of_whole_pages(path: Path, copy: Path) -> Path:
    """A copy without the page that is cut through, of which sqlite3 would take the missing part for zeros."""
    with path.open("rb") as source, copy.open("wb") as target:
        shutil.copyfileobj(source, target)
        page, _ = _pages(path)
        target.truncate(target.tell() // page * page)
    return copy
