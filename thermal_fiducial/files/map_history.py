"""Earlier versions of a map file, kept in a folder beside it, for undo; and the copy that a running mapper leaves.

Everybody who changes a map goes through here: one at a time, and only on top of what he has read.
"""

from contextlib import suppress
from dataclasses import dataclass
import hashlib
from pathlib import Path
import re

from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.atomic import clean_up, locked, sync_folder, write_atomically
from thermal_fiducial.files.map_format import parse_document
from thermal_fiducial.files.marker_map import dump_map
from thermal_fiducial.files.reading import cannot_write, read_bytes, read_text, TEXT_LIMIT_BYTES

#: Earlier versions kept.
KEPT = 50
#: What is said of an autosaved map that is taken up, or put aside.
TAKE_UP = 'take up the autosaved map'
PUT_ASIDE = 'an autosaved map that was never taken up'
_MARK = '# before: '
_NAME = re.compile(r'[0-9]{1,9}\.yaml')


class ChangedMeanwhileError(InputError):
    """Somebody else has changed the map since it was read."""


@dataclass(frozen=True)
class MapVersion:
    """An earlier version."""

    number: int
    path: Path
    #: what was done to it then
    action: str
    #: revision and number of markers that it had; 0 when it cannot be read
    revision: int = 0
    markers: int = 0
    #: why it cannot be read, in words
    problem: str = ''


def history_folder(path: Path) -> Path:
    """Where the earlier versions of the map at ``path`` are."""
    return path.with_name(f'{path.name}.history')


def autosave_file(path: Path) -> Path:
    """Where a running mapper leaves its copy of the map at ``path``."""
    return path.with_name(f'{path.name}.autosave')


def digest(path: Path) -> str:
    """What distinguishes the present content of ``path`` from any other; empty when there is none that can be read."""
    try:
        return _digest(read_bytes(path, TEXT_LIMIT_BYTES))
    except InputError:
        return ''


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def save_with_history(path: Path, marker_map: MarkerMap, action: str, read: str | None = None) -> str:
    """Write ``marker_map`` to ``path``, the file that is there now (whatever it holds) into its history.

    Parameters
    ----------
    path : the map file
    marker_map : the map
    action : what was done, in words
    read : :func:`digest` of the file that the map follows; None: whatever there is

    Returns
    -------
    :func:`digest` of what was written, whatever others have made of it since.

    Raises
    ------
    InputError
        The folder can't be written to, or (:class:`ChangedMeanwhileError`) the file is not the one that was read.
    """
    text = dump_map(marker_map)
    with locked(path):
        if read is not None and digest(path) not in (read, ''):
            raise ChangedMeanwhileError(f'{path}: changed by another program meanwhile; nothing is written')
        replace(path, text, action)
    return _digest(text.encode())


def replace(path: Path, text: str, action: str) -> None:
    """Put ``text`` into ``path``, what was there into its history; only under :func:`locked`.

    Raises
    ------
    InputError
        The folder can't be written to, or what is there is larger than any map, or no file.
    """
    try:
        clean_up(path)
        if path.exists():
            earlier = _whatever(path)
            if earlier == text:
                return
            keep(path, earlier, action)
        write_atomically(path, text)
    except OSError as error:
        raise cannot_write(path, 'the map', error) from None


def _whatever(path: Path) -> str:
    """The text in a file, whatever it is; raises InputError for what no map can be."""
    return read_bytes(path, TEXT_LIMIT_BYTES).decode('utf-8', errors='replace')


def keep(path: Path, text: str, action: str) -> None:
    """Put ``text`` into the history of ``path``; only under :func:`locked`. Raises OSError."""
    folder = history_folder(path)
    folder.mkdir(exist_ok=True)
    # Of writers that were killed.
    for litter in folder.glob('.*.tmp'):
        litter.unlink(missing_ok=True)
    files = _files(path)
    number = int(files[-1].stem) + 1 if files else 1
    write_atomically(folder / f'{number:06d}.yaml', f'{_MARK}{" ".join(action.split())}\n{text}')
    for file in files[: max(0, len(files) + 1 - KEPT)]:
        file.unlink(missing_ok=True)


def entries(path: Path) -> list[MapVersion]:
    """Earlier versions of the map at ``path``, the oldest first; those that cannot be read say why."""
    return [_entry(file) for file in _files(path)]


def _entry(file: Path) -> MapVersion:
    number = int(file.stem)
    try:
        text = read_text(file)
        document = parse_document(str(file), text)
    except InputError as error:
        return MapVersion(number, file, '', problem=str(error))
    return MapVersion(number, file, _action(text), document.revision, len(document.markers))


def _action(text: str) -> str:
    first = text.partition('\n')[0]
    return first.removeprefix(_MARK) if first.startswith(_MARK) else ''


def _files(path: Path) -> list[Path]:
    try:
        found = [file for file in history_folder(path).iterdir() if _NAME.fullmatch(file.name)]
    except OSError:
        return []
    return sorted(found, key=lambda file: int(file.stem))


def undo(path: Path) -> MapVersion:
    """Put the latest earlier version that can be read back in place, byte for byte.

    Raises
    ------
    InputError
        There is none, or it can't be written.
    """
    with locked(path):
        earlier = [entry for entry in entries(path) if not entry.problem]
        if not earlier:
            raise InputError(f'{path}: no earlier version is kept')
        last = earlier[-1]
        text = read_text(last.path)
        try:
            clean_up(path)
            write_atomically(path, text.partition('\n')[2] if text.startswith(_MARK) else text)
            last.path.unlink()
        except OSError as error:
            raise cannot_write(path, 'the map', error) from None
        return last


def autosaved(path: Path) -> MapVersion | None:
    """The copy of a mapper that ended without saving, if it is newer than the map itself."""
    file = autosave_file(path)
    try:
        if path.exists() and file.stat().st_mtime_ns < path.stat().st_mtime_ns:
            return None
        document = parse_document(str(file), read_text(file))
    except (OSError, InputError):
        return None
    return MapVersion(0, file, TAKE_UP, document.revision, len(document.markers))


def take_up_autosave(path: Path) -> None:
    """Make the autosaved map the map; the present one goes into the history.

    Raises
    ------
    InputError
        There is none, or it cannot be read or written.
    """
    file = autosave_file(path)
    with locked(path):
        text = read_text(file)
        parse_document(str(file), text)
        replace(path, text, TAKE_UP)
        with suppress(OSError):
            file.unlink()


def put_autosave_aside(path: Path) -> None:
    """Move an autosaved map that nobody has taken up into the history; only under :func:`locked`.

    Raises
    ------
    OSError
        The history cannot be written.
    InputError
        What is there is larger than any map.
    """
    file = autosave_file(path)
    if file.is_file():
        keep(path, _whatever(file), PUT_ASIDE)
        file.unlink(missing_ok=True)
        sync_folder(path.resolve().parent)
