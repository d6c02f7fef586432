"""Validation of a bag: before the library opens it, and of the metadata that the library returns."""

import os
from pathlib import Path

from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import require_regular
from thermal_fiducial.files.schema import load_yaml

#: Suffixes of bags that are a single file.
SINGLE_FILES = ('.mcap', '.db3', '.bag')
#: Suffixes of a bag's files; other files in its folder are not opened.
_SUFFIXES = (*SINGLE_FILES, '.zstd')
#: First and last bytes of an mcap file.
_MCAP_MAGIC = b'\x89MCAP0\r\n'
_ROS1_BEGIN = b'#ROSBAG V2.0\n'
_LARGEST_NUMBER = 2**63


def check_file(path: Path) -> None:
    """Raise InputError for files on which the library would block, or which it would read whole before refusing."""
    if path.suffix in _SUFFIXES:
        require_regular(path)
    if path.suffix == '.mcap':
        _check_mcap(path)
    if path.suffix == '.db3':
        _check_sqlite3(path)
    if path.suffix == '.bag':
        with path.open('rb') as file:
            if file.read(len(_ROS1_BEGIN)) != _ROS1_BEGIN:
                raise InputError(f'{path}: no bag of ROS 1 (2.0)')


def _check_mcap(path: Path) -> None:
    """Raise InputError for a recording that was cut off: it has the beginning of a file, but not its end."""
    with path.open('rb') as file:
        begin = file.read(len(_MCAP_MAGIC))
        file.seek(-min(path.stat().st_size, len(_MCAP_MAGIC)), os.SEEK_END)
        end = file.read()
    if begin == _MCAP_MAGIC != end:
        raise InputError(f'{path}: the recording of this bag was cut off, or goes on: mcap recover {path} -o NEW.mcap')


def _check_sqlite3(path: Path) -> None:
    """Raise InputError for a recording with messages beside its file, which the library would leave out."""
    for beside in (path.with_name(f'{path.name}{suffix}') for suffix in ('-wal', '-journal')):
        if beside.is_file() and beside.stat().st_size:
            remedy = f'sqlite3 {path} "SELECT count(*) FROM messages" completes it'
            raise InputError(f'{path}: the recording of this bag was cut off, or goes on: {remedy}')


def check_metadata(path: Path) -> None:
    """Raise InputError for a ``metadata.yaml`` that breaks the library's parser or has a non-number for a number."""
    root = load_yaml(path).mapping()
    information = root['rosbag2_bagfile_information'].mapping() if 'rosbag2_bagfile_information' in root else {}
    # Missing entries are reported by the library.
    for name, part in (('duration', 'nanoseconds'), ('starting_time', 'nanoseconds_since_epoch')):
        numbers = information[name].mapping() if name in information else {}
        if part in numbers:
            numbers[part].integer(0, _LARGEST_NUMBER)
    if 'message_count' in information:
        information['message_count'].integer(0, _LARGEST_NUMBER)


def check_announced(path: Path, reader: Rosbag1Reader | Rosbag2Reader) -> None:
    """Raise InputError for metadata of a wrong type: metadata.yaml may contain anything."""
    numbers = [reader.start_time, reader.duration, reader.message_count]
    numbers += [connection.msgcount for connection in reader.connections]
    # The range of int64 nanoseconds plus one, since the library's end time lies one behind the last message.
    if not all(type(number) is int and 0 <= number <= _LARGEST_NUMBER for number in numbers):
        raise InputError(f'{path}: the bag cannot be read: its metadata has times or counts that are none')
    names = [name for connection in reader.connections for name in (connection.topic, connection.msgtype)]
    if not all(isinstance(name, str) and name.isprintable() for name in names):
        raise InputError(f'{path}: the bag cannot be read: its metadata has topics or types that are no names')
