"""History of a map file for undo, in a folder beside it, and the autosaved copy of a running mapper.

Every change of a map file goes through this module: under a lock, and only if the file is still the one that was read.
"""

from contextlib import suppress
from dataclasses import dataclass
import glob
import hashlib
from pathlib import Path
import re

from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.atomic import clean_up, locked, sync_folder, target, write_atomically
from thermal_fiducial.files.map_format import parse_document
from thermal_fiducial.files.marker_map import dump_map
from thermal_fiducial.files.reading import read_bytes, read_text, TEXT_LIMIT_BYTES
from thermal_fiducial.files.writing import into

#: Number of earlier versions kept.
KEPT = 50
#: Action of the history for an autosaved map.
TAKE_UP = 'take up the autosaved map'
PUT_ASIDE = 'an autosaved map that was never taken up'
_MARK = '# before: '
_ORIGIN = '# from the map: '
_NAME = re.compile(r'[0-9]{1,9}\.yaml')


class ChangedMeanwhileError(InputError):
    """The map file has changed since it was read."""


@dataclass(frozen=True)
class MapVersion:
    """An earlier version."""

    number: int
    path: Path
    #: the change that replaced it
    action: str
    #: its revision and number of markers; 0 if it cannot be read
    revision: int = 0
    markers: int = 0
    #: why it cannot be read; else empty
    problem: str = ''
    #: of an autosave: whether another map has been written since
    outdated: bool = False

    @property
    def content(self) -> str:
        """Its revision and size in words, or why it cannot be read."""
        return self.problem or f'revision {self.revision}, {number_of(self.markers, "marker")}'


def history_folder(path: Path) -> Path:
    """Folder of the earlier versions of the map at ``path``."""
    return _beside(path, 'history')


def autosave_file(path: Path, robot: str = '') -> Path:
    """Autosave file of the map at ``path``, into which the mapper of a ``robot`` maps; empty: without a namespace."""
    return _beside(path, f'autosave.{robot}' if robot else 'autosave')


def _beside(path: Path, ending: str) -> Path:
    """A path beside the file itself, as a symbolic link may lead to the map of another place tomorrow.

    Raises
    ------
    InputError
        The path has no name, as ``.`` and ``/``.
    """
    if not path.name:
        raise InputError(f'{path}: is a folder, not a file')
    file = path
    # Links that lead round are reported by whoever reads or writes the map.
    with suppress(OSError):
        file = target(path) if path.is_symlink() else path
    return file.with_name(f'{file.name}.{ending}')


def digest(path: Path) -> str:
    """Hash of the present content of ``path``; empty if it cannot be read."""
    try:
        return _digest(read_bytes(path, TEXT_LIMIT_BYTES))
    except InputError:
        return ''


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def save_with_history(path: Path, marker_map: MarkerMap, action: str, read: str | None = None) -> str:
    """Write ``marker_map`` to ``path`` and move the present file, whatever its content, to the history.

    Parameters
    ----------
    path : the map file
    marker_map : the map
    action : description of the change
    read : :func:`digest` of the file that the map was made from; None: do not check

    Returns
    -------
    :func:`digest` of the written text, even if the file has changed since.

    Raises
    ------
    InputError
        The folder can't be written to, or (:class:`ChangedMeanwhileError`) the file has changed since it was read.
    """
    text = dump_map(marker_map)
    with locked(path):
        if read is not None and digest(path) not in (read, ''):
            raise ChangedMeanwhileError(f'{path}: changed by another program meanwhile; nothing is written')
        replace(path, text, action)
    return _digest(text.encode())


def replace(path: Path, text: str, action: str) -> None:
    """Write ``text`` to ``path`` and its present content to the history; only under :func:`locked`.

    Raises
    ------
    InputError
        The folder can't be written to, or the present file is too large or not a regular file.
    """
    with into(path):
        clean_up(path)
        if path.exists():
            earlier = _whatever(path)
            if earlier == text:
                return
            keep(path, earlier, action)
        write_atomically(path, text)


def _whatever(path: Path) -> str:
    """The text of a file, valid map or not; raises InputError if it is too large or not a regular file."""
    return read_bytes(path, TEXT_LIMIT_BYTES).decode('utf-8', errors='replace')


def keep(path: Path, text: str, action: str) -> None:
    """Add ``text`` to the history of ``path``; only under :func:`locked`. Raises OSError."""
    folder = history_folder(path)
    folder.mkdir(exist_ok=True)
    # Temporary files of killed writers.
    for litter in folder.glob('.*.tmp'):
        litter.unlink(missing_ok=True)
    files = _files(path)
    number = int(files[-1].stem) + 1 if files else 1
    write_atomically(folder / f'{number:06d}.yaml', f'{_MARK}{" ".join(action.split())}\n{text}')
    for file in files[: max(0, len(files) + 1 - KEPT)]:
        file.unlink(missing_ok=True)


def entries(path: Path) -> list[MapVersion]:
    """Earlier versions of the map at ``path``, oldest first; unreadable ones with their ``problem``."""
    return [_entry(file, int(file.stem)) for file in _files(path)]


def _entry(file: Path, number: int, later: str = '') -> MapVersion:
    """The version in a file; ``later``: :func:`digest` of a map that is said to have been written after it."""
    try:
        text = read_text(file)
        document = parse_document(str(file), text)
    except InputError as error:
        return MapVersion(number, file, '', problem=str(error), outdated=bool(later))
    # Where a clock begins anew with each flight, that of the file's own origin may seem to be later.
    outdated = bool(later) and not text.startswith(f'{_ORIGIN}{later}\n')
    return MapVersion(number, file, _action(text), document.revision, len(document.markers), outdated=outdated)


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
    """Restore the latest readable version, byte for byte.

    Raises
    ------
    InputError
        There is none, or the file can't be written.
    """
    with locked(path):
        kept = entries(path)
        earlier = [entry for entry in kept if not entry.problem]
        if not earlier:
            unreadable = f' that can be read: {kept[-1].problem}' if kept else ''
            raise InputError(f'{path}: no earlier version is kept{unreadable}')
        last = earlier[-1]
        text = read_text(last.path)
        with into(path):
            clean_up(path)
            write_atomically(path, text.partition('\n')[2] if text.startswith(_MARK) else text)
            last.path.unlink()
        return last


def autosaves(path: Path) -> list[MapVersion]:
    """What mappers that run, or ended without saving, have autosaved; oldest first.

    Unreadable ones are among them, with their ``problem``.
    """
    found, since_ns, present = [], 0, digest(path)
    with suppress(OSError, InputError):
        own = autosave_file(path)
        since_ns = path.stat().st_mtime_ns if path.exists() else 0
        for file in (own, *own.parent.glob(f'{glob.escape(own.name)}.*')):
            # A mapper that runs may save, and delete it; one that was edited has a history of its own beside it.
            with suppress(OSError):
                if file.is_file():
                    found.append((file.stat().st_mtime_ns, file))
    return [_entry(file, 0, present if written_ns < since_ns else '') for written_ns, file in sorted(found)]


def with_origin(text: str, origin: str) -> str:
    """The text of an autosave; ``origin``: :func:`digest` of the file that its mapper has read or saved last."""
    return f'{_ORIGIN}{origin}\n{text}'


def _without_origin(text: str) -> str:
    return text.partition('\n')[2] if text.startswith(_ORIGIN) else text


def autosaved(path: Path) -> MapVersion | None:
    """The newest of the :func:`autosaves` that can be read and is not outdated."""
    usable = (entry for entry in reversed(autosaves(path)) if not (entry.problem or entry.outdated))
    return next(usable, None)


def take_up_autosave(path: Path, file: Path) -> None:
    """Replace the map by the autosaved one in ``file``; the present map goes into the history.

    Raises
    ------
    InputError
        It cannot be read, or the map cannot be written.
    """
    with locked(path):
        text = read_text(file)
        parse_document(str(file), text)
        replace(path, _without_origin(text), TAKE_UP)
        with suppress(OSError):
            file.unlink()


def put_autosave_aside(path: Path, file: Path) -> None:
    """Move an unused autosaved map in ``file`` into the history; only under :func:`locked`.

    Raises
    ------
    OSError
        The history cannot be written.
    InputError
        The autosave is too large for a map.
    """
    if file.is_file():
        keep(path, _without_origin(_whatever(file)), PUT_ASIDE)
        file.unlink(missing_ok=True)
        sync_folder(path.resolve().parent)
