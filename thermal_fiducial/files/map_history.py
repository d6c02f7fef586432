"""Earlier versions of a map file, kept in a folder beside it, for undo."""

from dataclasses import dataclass
from pathlib import Path

from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import load_map, save_map, write_atomically

#: Earlier versions kept.
KEPT = 50
_MARK = '# before: '


@dataclass(frozen=True)
class Entry:
    """An earlier version."""

    number: int
    path: Path
    #: what was done to it then
    action: str
    #: version that the map had
    version: int
    markers: int


def history_folder(path: Path) -> Path:
    """Where the earlier versions of the map at ``path`` are."""
    return path.with_name(f'{path.name}.history')


def save_with_history(path: Path, marker_map: MarkerMap, action: str) -> None:
    """Write ``marker_map`` to ``path``, the file that is there now (whatever it holds) into its history.

    Raises
    ------
    InputError
        The folder can't be written to.
    """
    if path.exists():
        folder = history_folder(path)
        earlier = _files(path)
        number = int(earlier[-1].stem) + 1 if earlier else 1
        try:
            folder.mkdir(exist_ok=True)
            text = path.read_text(encoding='utf-8')
            write_atomically(folder / f'{number:06d}.yaml', f'{_MARK}{" ".join(action.split())}\n{text}')
        except OSError as error:
            raise InputError(f'{folder}: cannot keep the earlier map: {error.strerror}') from error
        for file in _files(path)[:-KEPT]:
            file.unlink()
    save_map(path, marker_map)


def entries(path: Path) -> list[Entry]:
    """Earlier versions of the map at ``path``, the oldest first."""
    found = []
    for file in _files(path):
        first = file.read_text(encoding='utf-8').partition('\n')[0]
        earlier = load_map(file, marker_size=1.0)
        action = first.removeprefix(_MARK) if first.startswith(_MARK) else ''
        found.append(Entry(int(file.stem), file, action, earlier.version, len(earlier.markers)))
    return found


def _files(path: Path) -> list[Path]:
    return sorted(history_folder(path).glob('[0-9]*.yaml'))


def undo(path: Path) -> Entry:
    """Put the latest earlier version back in place, byte for byte.

    Raises
    ------
    InputError
        There is none.
    """
    earlier = entries(path)
    if not earlier:
        raise InputError(f'{path}: no earlier version is kept')
    last = earlier[-1]
    text = last.path.read_text(encoding='utf-8')
    write_atomically(path, text.partition('\n')[2] if text.startswith(_MARK) else text)
    last.path.unlink()
    return last
