"""The map file of a running mapper: load, save, autosave, recovery."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from shlex import quote
import tempfile
from threading import Thread
import time

from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import map_history
from thermal_fiducial.files.atomic import locked, write_atomically
from thermal_fiducial.files.map_history import MapVersion
from thermal_fiducial.files.marker_map import dump_map, load_map
from thermal_fiducial.files.robot_folder import robot_folder
from thermal_fiducial.files.writing import into

#: A mapper that starts within so many autosave periods of the last autosave resumes it as after a crash.
RESTART_PERIODS = 2.0


class MapKeeper:
    """Loads and saves one map file.

    Parameters
    ----------
    path : the file; None: no file
    marker_size : side of markers whose entry has none [m]
    size_overrides : marker ID to side [m], instead of ``marker_size``
    flown : the map was made in flight and cannot be repeated: if its folder is not writable, save it elsewhere
    robot : whose mapper it is, in the name of its autosave; empty: of a robot without a namespace
    """

    def __init__(
        self,
        path: Path | None,
        marker_size: float,
        size_overrides: Mapping[int, float],
        *,
        flown: bool = True,
        robot: str = '',
    ) -> None:
        self._path = path
        self._sizes = marker_size, size_overrides
        self._flown = flown
        self._robot = robot
        # Digests of the file that the map was made from, and of the one read last. 'nothing' matches no file: an unread
        # one is not overwritten.
        self._read = self._at_hand = 'nothing'
        #: digest of the file as it was read or saved last, also of one that could not be read as a map
        self._origin = ''
        self._own_autosave = False
        self._writer: Thread | None = None
        #: why the last autosave could not be written; empty if it was
        self.fault = ''
        #: whether the map has changed since it was loaded, or copied to be saved
        self.unsaved = False
        #: why the last save could not replace the file; empty if it did
        self.obstacle = ''

    @property
    def path(self) -> Path:
        """The file.

        Raises
        ------
        InputError
            There is none.
        """
        if self._path is None:
            raise InputError('parameter map_file is empty: there is no map on disk')
        return self._path

    @property
    def _autosave_file(self) -> Path:
        return map_history.autosave_file(self.path, self._robot)

    def read(self) -> MarkerMap:
        """The map in the file, which :meth:`take` makes the one at hand.

        Raises
        ------
        InputError
            There is no file, or it cannot be read.
        """
        self.finish()
        self._origin = digest = map_history.digest(self.path)
        marker_map = load_map(self.path, *self._sizes)
        self._at_hand = digest
        return marker_map

    def take(self) -> None:
        """The map that was read last replaces the one before, which :meth:`put_aside` has kept if it was not saved."""
        self._read, self.unsaved = self._at_hand, False

    def recover(self, autosave_period: float) -> tuple[MarkerMap | None, str]:
        """The autosaved map of this mapper if it has just crashed (or None), and a message about autosaves.

        Parameters
        ----------
        autosave_period : of this mapper [s]; 0: no autosave is resumed
        """
        if self._path is None:
            return None, ''
        marker_map, notes = None, []
        for entry in map_history.autosaves(self._path):
            if entry.path == self._autosave_file:
                marker_map, note = self._resumed(entry, autosave_period)
            elif entry.outdated:
                continue
            else:
                note = f'{entry.path} ({entry.content}) is of the mapper of another robot, which runs or crashed'
            notes.append(note)
        return marker_map, '; '.join(notes)

    def _resumed(self, entry: MapVersion, autosave_period: float) -> tuple[MarkerMap | None, str]:
        """The own autosave if it is to be resumed, and a message about it."""
        found, file = f'{entry.path} ({entry.content})', quote(str(self._path))
        if entry.problem or entry.outdated:
            why = entry.problem or f'{found} was never saved, but another map has been written since'
            return None, f'{why}; the next autosave moves it to {map_history.history_folder(self.path)}'
        try:
            age_s = time.time() - entry.path.stat().st_mtime
            if not 0.0 <= age_s <= RESTART_PERIODS * autosave_period:
                return None, f'{found} was never saved: thermal-fiducial map undo {file} takes it up'
            recovered = load_map(entry.path, *self._sizes)
        except OSError as error:
            return None, f'{entry.path}: {error.strerror}'
        except InputError as error:
            return None, str(error)
        # If this mapper crashes before its own first autosave, this one is still that of the mapper just before.
        with suppress(OSError):
            entry.path.touch()
        self.unsaved = self._own_autosave = True
        return recovered, f'goes on with {found}, {age_s:.0f} s old, as the last mapper did not end in order'

    def save(self, marker_map: MarkerMap) -> Path:
        """Write the map to its file, or beside it if the file is not the one that was loaded.

        It leaves :attr:`unsaved` to whoever has copied the map: more may have been learned since.

        If that folder cannot be written to (full or read-only disk), a flown map is saved in the folder where the
        filter keeps its clock offset, or else in a new temporary folder.

        Returns
        -------
        Path of the written file; :attr:`obstacle` says why it is not the map file.

        Raises
        ------
        InputError
            Nothing can be written anywhere.
        """
        self.finish()
        self.obstacle = ''
        try:
            self._read = self._origin = map_history.save_with_history(self.path, marker_map, 'save', self._read)
        except InputError as error:
            self.obstacle = str(error)
            path = self._save_elsewhere(marker_map, 'new')
            # Else it was resumed, or offered for undo, instead of what another program wrote to the map.
            if self._own_autosave and path.parent == self.path.parent:
                self._retire_autosave()
            return path
        self.fault = ''
        self._retire_autosave()
        return self.path

    def put_aside(self, marker_map: MarkerMap) -> Path | None:
        """Write a map that is about to be replaced beside its file, and remove its autosave.

        Returns
        -------
        The written file; None if the map was saved.

        Raises
        ------
        InputError
            Nothing can be written anywhere.
        """
        self.obstacle = ''
        aside = self._save_elsewhere(marker_map, 'replaced') if self.unsaved and marker_map.markers else None
        if self._own_autosave:
            self._retire_autosave()
        return aside

    def _save_elsewhere(self, marker_map: MarkerMap, kind: str) -> Path:
        name = f'{self.path.stem}.{kind}{self.path.suffix}'
        others: tuple[Callable[[], Path], ...] = (_own_folder, _new_folder) if self._flown else ()
        reason = self.obstacle
        for folder in (lambda: self.path.parent, *others):
            try:
                path = folder() / name
                map_history.save_with_history(path, marker_map, 'save')
            except (OSError, InputError) as error:
                reason = reason or str(error)
            else:
                return path
        self.unsaved = True
        raise InputError(f'the map is not saved: {reason}')

    def undo(self) -> str:
        """Restore the previous version of the file; returns the undone action.

        Raises
        ------
        InputError
            There is no earlier version.
        """
        return map_history.undo(self.path).action

    def autosave(self, marker_map: MarkerMap) -> None:
        """Write a copy of a changed map beside its file, in a thread, since disks are slow; see :attr:`fault`."""
        if self._path is not None and self.unsaved and (self._writer is None or not self._writer.is_alive()):
            self._writer = Thread(target=self._autosave, args=(marker_map.copy(),), daemon=True)
            self._writer.start()

    def _autosave(self, marker_map: MarkerMap) -> None:
        file = self._autosave_file
        try:
            text = map_history.with_origin(dump_map(marker_map), self._origin)
            with locked(self.path), into(file):
                if not self._own_autosave:
                    map_history.put_autosave_aside(self.path, file)
                write_atomically(file, text)
        except InputError as error:
            self.fault = f'no autosave: {error}'
            return
        self._own_autosave, self.fault = True, ''

    def _retire_autosave(self) -> None:
        """After a save delete the own autosave; move one of an earlier mapper into the history."""
        with suppress(OSError, InputError), locked(self.path):
            if self._own_autosave:
                self._autosave_file.unlink(missing_ok=True)
            else:
                map_history.put_autosave_aside(self.path, self._autosave_file)
        self._own_autosave = False

    def finish(self) -> None:
        """Wait for a running autosave."""
        if self._writer is not None:
            self._writer.join()


def _own_folder() -> Path:
    folder = robot_folder()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _new_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix='thermal_fiducial_'))
