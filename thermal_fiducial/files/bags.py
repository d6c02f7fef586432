"""Reader of bags, rosbag2 (mcap and sqlite3) and ROS 1, without ROS.

Topics have the names of the package's interface, relative and without the leading slash. Bags recorded with a
leading slash or in a namespace are resolved automatically; other names need a remap, as in ROS.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_checks import check_announced, check_file, check_metadata, SINGLE_FILES
from thermal_fiducial.files.decompression import bound_decompression
from thermal_fiducial.files.reading import one_line, shown

IMAGE_TOPIC = 'thermal/image_raw'
COMPRESSED_TOPIC = 'thermal/image_raw/compressed'
CAMERA_INFO_TOPIC = 'thermal/camera_info'
IMU_TOPIC = 'imu/data'
MARKERS_TOPIC = 'markers'
CAMERA_POSE_TOPIC = 'camera_pose'
MAP_ERROR_TOPIC = 'camera_pose/map_error'
TRUTH_TOPIC = 'ground_truth/odometry'

#: First bytes of what zstd has compressed; a serialised message begins with a zero.
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
#: Topics that a second camera has in its namespace.
_OF_CAMERA = (IMAGE_TOPIC, COMPRESSED_TOPIC, CAMERA_INFO_TOPIC, MARKERS_TOPIC)
#: Names that are resolved in any namespace of the bag.
INTERFACE_TOPICS = (IMAGE_TOPIC, COMPRESSED_TOPIC, CAMERA_INFO_TOPIC, IMU_TOPIC, TRUTH_TOPIC)
#: The same for outputs of the nodes. Other topics may have the same ending (``marker_map/markers``), so these names
#: are not resolved if several match.
_COMMON_NAMES = (MARKERS_TOPIC, CAMERA_POSE_TOPIC, MAP_ERROR_TOPIC)


@dataclass(frozen=True)
class BagMessage:
    """One recorded message.

    Parameters
    ----------
    topic : interface name, see :func:`resolve_topics`
    msgtype : e.g. ``sensor_msgs/msg/Image``
    stamp_ns : time of recording (not the header's stamp)
    cdr : serialised message, as accepted by rclpy's ``publish``
    """

    topic: str
    msgtype: str
    stamp_ns: int
    cdr: bytes
    _typestore: Typestore

    @cached_property
    def message(self) -> Any:
        """The deserialised message, an object with the fields of the ROS type.

        Raises
        ------
        InputError
            Bytes that are not a message of this type.
        """
        try:
            return self._typestore.deserialize_cdr(self.cdr, self.msgtype)
        except Exception as error:  # the library does not wrap errors of malformed data
            raise InputError(f'{self.topic} at {self.stamp_ns}: no {self.msgtype}: {one_line(error)}') from None


def resolve_topics(
    recorded: Iterable[str], remap: Mapping[str, str] | None = None, second_camera: str = ''
) -> dict[str, str]:
    """Recorded topic to interface name.

    A remapped topic gets its new name. Otherwise ``/any/namespace/imu/data`` becomes ``imu/data`` unless the bag has
    that name itself; every other topic only loses its leading slash. Topics of a second camera keep its name.

    Raises
    ------
    InputError
        A remap of a missing topic, or two topics for one name.
    """
    names = {topic: topic.strip('/') for topic in recorded}
    renamed = {source.strip('/'): target.strip('/') for source, target in (remap or {}).items()}
    for source in renamed:
        if source not in names.values():
            raise InputError(f'no topic {source} to remap; the bag has: {", ".join(sorted(names.values())) or "none"}')
    names = {topic: renamed.get(name, name) for topic, name in names.items()}
    seconds = [f'{second_camera}/{topic}' for topic in _OF_CAMERA] if second_camera else []
    for wanted in (*seconds, *INTERFACE_TOPICS, *_COMMON_NAMES):
        matches = [topic for topic, name in names.items() if name.endswith('/' + wanted) and name not in seconds]
        if wanted in _COMMON_NAMES:
            matches = [topic for topic in matches if not names[topic].endswith('marker_map/markers')]
        if wanted in names.values() or (wanted in _COMMON_NAMES and len(matches) > 1):
            continue
        if len(matches) > 1:
            raise InputError(f'{" and ".join(sorted(matches))} could both be {wanted}: choose one with a remap')
        names.update(dict.fromkeys(matches, wanted))
    doubles = sorted(name for name in set(names.values()) if list(names.values()).count(name) > 1)
    if doubles:
        raise InputError(f'several topics of the bag became {doubles[0]}: check the remaps')
    return names


def parse_remaps(arguments: Iterable[str]) -> dict[str, str]:
    """Remaps of the command line, each ``from:=to``.

    Raises
    ------
    InputError
        An argument of another form.
    """
    remaps = {}
    for argument in arguments:
        source, separator, target = argument.partition(':=')
        if not (separator and source.strip('/') and target.strip('/')):
            raise InputError(f'remap {argument!r} is not from:=to')
        remaps[source] = target
    return remaps


def _what_is_missing(folder: Path) -> str:
    """What keeps a folder from being a bag, with the remedy if there is one."""
    files = [file for file in folder.iterdir() if file.suffix in SINGLE_FILES]
    if len(files) == 1:
        return f'no metadata.yaml (ros2 bag reindex makes one; or give its file {files[0]})'
    if files:
        return 'no metadata.yaml (ros2 bag reindex makes one)'
    return f'neither metadata.yaml nor a file {", ".join(SINGLE_FILES)}'


class BagReader:
    """A recorded bag, a context manager.

    Parameters
    ----------
    path : a rosbag2 folder, a single ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``
    remap : topic of the bag to interface name
    second_camera : namespace of a second camera in the bag; empty: none

    Raises
    ------
    InputError
        On entering and while reading: missing, empty, truncated or otherwise unreadable bag, ambiguous topics.
    """

    def __init__(self, path: str | Path, remap: Mapping[str, str] | None = None, *, second_camera: str = '') -> None:
        self.path = Path(path)
        self._remap, self._second_camera = remap, second_camera
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._names: dict[str, str] = {}
        self._reader: Rosbag1Reader | Rosbag2Reader | None = None

    def __enter__(self) -> Self:
        if not self.path.exists():
            raise InputError(f'{self.path}: no such bag')
        if not self.path.is_dir() and self.path.suffix not in SINGLE_FILES:
            raise InputError(f'{self.path}: no bag: neither a folder nor a file {", ".join(SINGLE_FILES)}')
        if self.path.is_dir() and not (self.path / 'metadata.yaml').exists():
            raise InputError(f'{self.path}: no bag, the folder has {_what_is_missing(self.path)}')
        if self.path.is_dir():
            check_metadata(self.path / 'metadata.yaml')
        for file in sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]:
            check_file(file)
        bound_decompression()
        with self._readable():
            is_ros1 = self.path.suffix == '.bag' and self.path.is_file()
            reader = Rosbag1Reader(self.path) if is_ros1 else Rosbag2Reader(self.path)
            reader.open()
        self._reader = reader
        try:
            check_announced(self.path, reader)
            if reader.message_count == 0:
                raise InputError(f'{self.path}: the bag is empty')
            recorded = {connection.topic for connection in reader.connections}
            self._names = resolve_topics(recorded, self._remap, self._second_camera)
        except InputError:
            reader.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def topics(self) -> dict[str, str]:
        """Interface name to message type."""
        return {self._names[connection.topic]: connection.msgtype for connection in self._open.connections}

    @property
    def start_ns(self) -> int:
        """Bag stamp of the first message."""
        return int(self._open.start_time)

    @property
    def duration_ns(self) -> int:
        """Time from the first to the last message."""
        return max(0, int(self._open.duration) - 1)  # the library's end time lies 1 ns behind the last message

    @property
    def image_topic(self) -> str:
        """Topic of the frames: raw, else compressed; raw if there are none."""
        return COMPRESSED_TOPIC if COMPRESSED_TOPIC in self.topics and IMAGE_TOPIC not in self.topics else IMAGE_TOPIC

    def require(self, topics: Mapping[str, str]) -> None:
        """Check that the bag has ``topics`` (name to message type).

        Raises
        ------
        InputError
            A topic is missing (the message lists those present), has another type, or no messages.
        """
        there = self.topics
        for topic, msgtype in topics.items():
            if topic not in there:
                listed = ', '.join(sorted(f'{shown(name)} ({kind})' for name, kind in there.items()))
                raise InputError(f'{self.path}: no topic {topic} ({_remedy(topic)}?); the bag has {listed}')
            if there[topic] != msgtype:
                raise InputError(f'{self.path}: topic {topic} is {there[topic]}, not {msgtype}')
            if self.message_count([topic]) == 0:
                raise InputError(f'{self.path}: no message on topic {topic}')

    def message_count(self, topics: Iterable[str] | None = None) -> int:
        """Number of messages on ``topics`` (default: all)."""
        return sum(connection.msgcount for connection in self._connections(topics))

    def messages(
        self, topics: Iterable[str] | None = None, between_ns: tuple[int, int] | None = None
    ) -> Iterator[BagMessage]:
        """Messages on ``topics`` (default: all) in recorded order, with bag stamps in ``between_ns`` (default: any).

        Raises
        ------
        InputError
            The bag is truncated or becomes unreadable.
        """
        connections = self._connections(topics)
        if not connections:
            return
        with self._readable():
            for connection, stamp_ns, raw in self._open.messages(connections, *(between_ns or (None, None))):
                name = self._names[connection.topic]
                yield BagMessage(name, connection.msgtype, stamp_ns, self._cdr(connection, raw), self._typestore)

    @property
    def _open(self) -> Rosbag1Reader | Rosbag2Reader:
        if self._reader is None:
            raise RuntimeError('the bag is not open')
        return self._reader

    def _connections(self, topics: Iterable[str] | None) -> list[Connection]:
        wanted = None if topics is None else set(topics)
        return [item for item in self._open.connections if wanted is None or self._names[item.topic] in wanted]

    def _cdr(self, connection: Connection, raw: bytes | memoryview) -> bytes:
        self._learn(connection)
        if isinstance(self._reader, Rosbag1Reader):
            return bytes(self._typestore.ros1_to_cdr(raw, connection.msgtype))
        cdr = bytes(raw)
        if cdr.startswith(_ZSTD_MAGIC):
            raise InputError(f'{self.path}: its messages are compressed, as metadata.yaml says: give the folder')
        return cdr

    def _learn(self, connection: Connection) -> None:
        """Register a type that is not part of ROS from its definition in the bag, if it has one."""
        text = connection.msgdef.data
        if connection.msgtype in self._typestore.fielddefs or not text:
            return
        idl = connection.msgdef.format.name == 'IDL'
        types = get_types_from_idl(text) if idl else get_types_from_msg(text, connection.msgtype)
        known = self._typestore.fielddefs
        self._typestore.register({name: fields for name, fields in types.items() if name not in known})

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Convert any exception of the library on a damaged file to InputError."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            raise InputError(f'{self.path}: the bag cannot be read: {one_line(error)}') from None


def _remedy(topic: str) -> str:
    """What to do about a topic that a bag lacks."""
    remap = 'remap another to it'
    if topic == TRUTH_TOPIC:
        return 'give a TUM file'
    return f'{remap}, or give a calibration_file' if topic == CAMERA_INFO_TOPIC else remap
