"""ROS 1 bags, ROS 2 bags and single MCAP or SQLite files as topics of messages, without ROS.

They are read by the library `rosbags`. Messages are taken by their standard definitions, not by those in
the file: an unknown type does not prevent reading the others, and no code is generated from a file.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from jaxekf._support.errors import RecordingError
from jaxekf.io.importers._bag_files import EmptyDefinitions, check_database, sizes

KINDS = {
    ".bag": "a ROS 1 bag",
    ".active": "a ROS 1 bag",
    ".mcap": "an MCAP file of ROS 2",
    ".db3": "an SQLite file of a ROS 2 bag",
}
_WANTED = "a ROS 1 bag (.bag), the folder of a ROS 2 bag, or one file of it (.mcap, .db3)"


class Topic(NamedTuple):
    """Messages of one name and type."""

    name: str
    type: str
    """Such as ``sensor_msgs/msg/Imu``, of ROS 1 too."""
    stated: int
    """Number of messages that the bag states."""


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any, typestore: Any, *, ros1: bool) -> None:
        self.path = path
        self._reader, self._types, self._ros1 = reader, typestore, ros1
        counts: dict[tuple[str, str], int] = {}
        for connection in reader.connections:
            key = (connection.topic, _type(connection.msgtype))
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def place(self, topic: Topic) -> str:
        """The topic's place in error messages."""
        return f"{self.path}:{topic.name}"

    def messages(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        """Time of receipt, ns, and message, in order of receipt.

        Raises `RecordingError` if one cannot be read, or if there are fewer than the bag states.
        """
        chosen = [
            connection
            for connection in self._reader.connections
            if (connection.topic, _type(connection.msgtype)) == topic[:2]
        ]
        self._check_definition(topic, chosen)
        parse = self._types.deserialize_ros1 if self._ros1 else self._types.deserialize_cdr
        count = 0
        try:
            # An empty list would mean every topic.
            for _, received, raw in self._reader.messages(chosen) if chosen else ():
                yield received, parse(raw, topic.type)
                count += 1
        except Exception as error:
            raise unreadable(self.path, error, f"{topic.name}[{count}]") from error
        if count < topic.stated:
            got = f"{count} messages{sizes(self.path)}"
            expected = f"the {topic.stated} that the bag states"
            raise RecordingError(self.place(topic), got, expected, _remedy(self.path))

    def _check_definition(self, topic: Topic, connections: list[Any]) -> None:
        """Raise if the file's type of this name is not the standard one."""
        if self._ros1:
            known = self._types.generate_msgdef(topic.type)[1]
            stated = {c.digest for c in connections} - {"", "*", None}
        else:
            known = self._types.hash_rihs01(topic.type)
            stated = {c.digest for c in connections if str(c.digest).startswith("RIHS01_")}
        if stated - {known}:
            got = f"a {topic.type} that is not the standard one ({', '.join(sorted(stated))})"
            hint = "converting its messages to the standard type"
            raise RecordingError(self.place(topic), got, known, hint)


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """A bag, closed at the end.

    Raises `RecordingError` if it is missing or cannot be read, or if `rosbags` is not installed.
    """
    try:
        _check_place(path)
    except OSError as error:
        raise RecordingError(
            path, f"a place that cannot be read ({error.strerror})", _WANTED, "its permissions"
        ) from error
    reader, typestore = _reader(path)
    try:
        try:
            try:
                reader.open()
            except KeyError as error:
                reader = EmptyDefinitions.instead(path, error)
            _check_total(path, reader)
            bag = Bag(path, reader, typestore, ros1=_is_ros1(path))
        except RecordingError:
            raise
        except Exception as error:
            raise unreadable(path, error) from error
        yield bag
    finally:
        with suppress(Exception):
            reader.close()


def unreadable(path: Path, error: Exception, part: str = "") -> RecordingError:
    """The error of a bag that the library cannot read, with its reason and the known sizes."""
    reason = " ".join(str(error).split()).rstrip(".")
    if isinstance(error, (LookupError, AssertionError)) or not reason:
        reason = f"{type(error).__name__} {reason}".strip()
    kind = "a readable ROS 2 bag" if path.is_dir() else f"{KINDS[path.suffix]} that is whole"
    place = f"{path}:{part}" if part else path
    return RecordingError(
        place, f"something that cannot be read ({reason}){sizes(path)}", kind, _remedy(path)
    )


def _remedy(path: Path) -> str:
    """Remedies for an incomplete bag."""
    other = "mcap recover" if path.suffix == ".mcap" else "ros2 bag reindex"
    return f"copying it again, or `{'rosbag reindex' if _is_ros1(path) else other}`"


def _is_ros1(path: Path) -> bool:
    return path.is_file() and path.suffix in (".bag", ".active")


def _check_place(path: Path) -> None:
    """Raise if the path cannot be a bag."""
    if not path.exists():
        raise RecordingError(path, "no such file or folder", _WANTED, "another path")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        parts = [file.name for file in sorted(path.iterdir()) if file.suffix in KINDS]
        got = f"a folder without metadata.yaml{' but with ' + ', '.join(parts) if parts else ''}"
        hint = "giving one of these files, or `ros2 bag reindex`" if parts else "another path"
        raise RecordingError(path, got, _WANTED, hint)
    if path.is_file() and path.suffix not in KINDS:
        raise RecordingError(path, f"a file '{path.name}'", _WANTED, "another path")
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        if file.suffix == ".db3":
            check_database(file)


def _reader(path: Path) -> tuple[Any, Any]:
    """The library's reader of a bag, not yet open, and the standard types."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        got = f"a bag without the library that reads it ({error})"
        expected = "rosbags to be installed"
        raise RecordingError(path, got, expected, "pip install 'jaxekf[ros]'") from error
    typestore = get_typestore(Stores.ROS1_NOETIC if _is_ros1(path) else Stores.LATEST)
    if _is_ros1(path):
        # ROS 1 defines transforms in a package of its own, which the library's standard types leave out.
        content = "geometry_msgs/TransformStamped[] transforms\n"
        for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            typestore.register(get_types_from_msg(content, name))
    try:
        return (rosbag1 if _is_ros1(path) else rosbag2).Reader(path), typestore
    except Exception as error:
        raise unreadable(path, error) from error


def _check_total(path: Path, reader: Any) -> None:
    """Raise for a truncated description that can be read but lacks topics."""
    listed = sum(connection.msgcount for connection in reader.connections)
    if listed < reader.message_count:
        place = path / "metadata.yaml" if path.is_dir() else path
        expected = f"the {reader.message_count} that it states"
        raise RecordingError(place, f"topics of {listed} messages in all", expected, _remedy(path))


def _type(name: str) -> str:
    """A type's name as ROS 2 writes it: some files leave out ``msg``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name
