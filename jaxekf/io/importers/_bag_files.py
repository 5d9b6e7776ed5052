"""Files of a bag examined without the library that reads them: sizes, truncation, databases."""

import re
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxekf._support.errors import RecordingError

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SQLITE_MAGIC = b"SQLite format 3\0"


def sizes(path: Path) -> str:
    """Sizes of the files, stated and actual, as words to append to a message."""
    files = sorted(path.glob("*.[dm][bc]*")) if path.is_dir() else [path]
    found = []
    for file in files:
        size = _truncation(file)
        if not size and file.is_file():
            size = f"has {file.stat().st_size} bytes"
        if size:
            found.append(f"{file.name} {size}" if path.is_dir() else f"it {size}")
    return f"; {', '.join(found)}" if found else ""


def _truncation(file: Path) -> str:
    """Evidence that a file is truncated, in words; blank without any."""
    try:
        size = file.stat().st_size
        with file.open("rb") as stream:
            head = stream.read(4096)
            stream.seek(max(size - 8, 0))
            tail = stream.read()
    except OSError:
        return ""
    if size == 0:
        return "is empty (0 bytes)"
    if head.startswith(_SQLITE_MAGIC) and len(head) >= 100:
        pages, page = _sqlite_pages(head)
        if pages * page > size:
            return f"has {size} bytes of the {pages * page} that it states"
    if head.startswith(_MCAP_MAGIC) and tail != _MCAP_MAGIC:
        return f"ends at byte {size} without its footer"
    if head.startswith(b"#ROSBAG V2.0\n"):
        at = re.search(rb"index_pos=(.{8})", head, re.DOTALL)
        index = struct.unpack("<Q", at[1])[0] if at else 0
        if index >= size:
            return f"has {size} bytes, and an index that it states at byte {index}"
    return ""


def _sqlite_pages(head: bytes) -> tuple[int, int]:
    """Number and size of the pages that a database states; 0 pages if the number is not up to date."""
    page = int.from_bytes(head[16:18], "big")
    # The number holds only where whoever wrote last kept it.
    kept = head[24:28] == head[92:96]
    return (int.from_bytes(head[28:32], "big") if kept else 0), (65536 if page == 1 else page)


def check_database(file: Path) -> None:
    """Raise if a database is truncated, or if its last messages are still in its log file."""
    with file.open("rb") as stream:
        head = stream.read(100)
    if not head.startswith(_SQLITE_MAGIC):
        return
    log = file.with_name(file.name + "-wal")
    if log.is_file() and log.stat().st_size:
        got = f"a database whose last messages are still in {log.name}"
        hint = f"`sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'`, and `ros2 bag reindex`"
        raise RecordingError(file, got, "one that was closed", hint)
    truncation = _truncation(file)
    if truncation:
        got = f"a database that {truncation}"
        expected = "an SQLite file of a ROS 2 bag that is whole"
        raise RecordingError(file, got, expected, "copying it again, or `sqlite3 FILE .recover`")


class _Stored(NamedTuple):
    """A topic of one of the databases, with the names that the library's own have."""

    topic: str
    msgtype: str
    msgcount: int
    digest: str = ""


class EmptyDefinitions:
    """Databases in which a type has no definition, as ROS 2 stores types that it did not find.

    The library stops at such a type, although what is asked for is another; the tables are plain enough.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = files
        self.connections: list[_Stored] = []
        for file in files:
            with self._open(file) as database:
                self.connections += [
                    _Stored(*row)
                    for row in database.execute(
                        "SELECT name, type, count(messages.id) FROM topics"
                        " LEFT JOIN messages ON topics.id = messages.topic_id GROUP BY topics.id"
                    )
                ]
        self.message_count = sum(connection.msgcount for connection in self.connections)

    @classmethod
    def instead(cls, path: Path, error: KeyError) -> "EmptyDefinitions":
        """A bag that the library refuses for this error, which is raised again if the cause is another."""
        files = [path]
        if path.is_dir():
            about = yaml.safe_load((path / "metadata.yaml").read_text("utf-8"))
            about = about["rosbag2_bagfile_information"]
            if about.get("compression_mode", "").lower() not in ("", "none"):
                raise error
            files = [path / Path(name).name for name in about["relative_file_paths"]]
        if any(file.suffix != ".db3" for file in files):
            raise error
        return cls(files)

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """As the library's readers do."""
        wanted = {(connection.topic, connection.msgtype): connection for connection in connections}
        marks = ", ".join(["(?, ?)"] * len(wanted))
        query = (
            "SELECT name, type, timestamp, data FROM messages JOIN topics"
            f" ON topics.id = messages.topic_id WHERE (name, type) IN (VALUES {marks})"
            " ORDER BY timestamp, messages.id"
        )
        for file in self._files:
            with self._open(file) as database:
                for *key, time, data in database.execute(
                    query, [k for pair in wanted for k in pair]
                ):
                    yield wanted[key[0], key[1]], time, data

    def close(self) -> None:
        """Nothing stays open."""

    @staticmethod
    def _open(file: Path) -> Any:
        return closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True))
