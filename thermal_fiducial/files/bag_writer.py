"""Writer of rosbag2 bags, mcap and sqlite3, without ROS."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import shutil
import sqlite3
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.writing import into

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


class BagWriter:
    """A new rosbag2, a context manager; the output is deterministic. An incomplete bag is removed on an exception.

    Parameters
    ----------
    path : folder to create
    storage : a key of :data:`STORAGES`

    Raises
    ------
    InputError
        The folder exists, cannot be made, or the storage is unknown.
    """

    def __init__(self, path: str | Path, storage: str = 'mcap') -> None:
        if storage not in STORAGES:
            raise InputError(f'storage {storage!r} is not one of {", ".join(STORAGES)}')
        if Path(path).exists():
            raise InputError(f'{path} exists already')
        self._path = Path(path)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        with self._removed_unless_whole(), self._written():
            self._writer.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._removed_unless_whole(), self._written():
            self._writer.__exit__(kind, value, traceback)
            if value is not None:
                raise value

    @contextmanager
    def _removed_unless_whole(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            # An incomplete bag could be taken for a complete flight.
            shutil.rmtree(self._path, ignore_errors=True)
            raise

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            with into(self._path):
                yield
        except sqlite3.Error as error:
            raise InputError(f'{self._path}: {error}') from None

    def add_topic(self, topic: str, msgtype: str) -> None:
        """Add ``topic``, even if it never gets a message.

        Raises
        ------
        InputError
            A type that is not part of ROS 2 Jazzy.
        """
        if msgtype not in self._typestore.fielddefs:
            raise InputError(f'{topic}: message type {msgtype} is unknown')
        name = topic if topic.startswith('/') else '/' + topic
        with self._written():
            self._connections[topic] = self._writer.add_connection(name, msgtype, typestore=self._typestore)

    def write(self, topic: str, stamp_ns: int, message: Any, msgtype: str | None = None) -> None:
        """Append a message.

        Parameters
        ----------
        topic : added if it is new
        stamp_ns : bag stamp
        message : one of rosbags' message objects, or its CDR bytes together with ``msgtype``

        Raises
        ------
        InputError
            The bag cannot be written, for example because the disk is full.
        """
        kind = msgtype or message.__msgtype__
        if topic not in self._connections:
            self.add_topic(topic, kind)
        is_raw = isinstance(message, (bytes, bytearray, memoryview))
        cdr = message if is_raw else self._typestore.serialize_cdr(message, kind)
        with self._written():
            self._writer.write(self._connections[topic], stamp_ns, cdr)
