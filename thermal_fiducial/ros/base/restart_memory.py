"""Restart after a crash in flight: what a node keeps in a file of its own, refreshed once a second."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.robot_folder import file_name_of, robot_folder
from thermal_fiducial.ros.base.node import StageNode


class RestartMemory:
    """Writes the file of a node of this name, and deletes it at the end of a flight.

    Parameters
    ----------
    node : the node
    active : whether there is such a file
    """

    def __init__(self, node: StageNode[Any], *, active: bool) -> None:
        name = file_name_of(node.get_fully_qualified_name())
        self.path = robot_folder() / f'{name}_{node.context.get_domain_id()}.json'
        self.active = active
        # That of the last save; the first one never runs.
        self._writer = Thread()
        #: why the last save failed, until that is reported
        self._fault: InputError | None = None
        node.completions.append(self._forget)

    def save(self, write: Callable[[Path], None], patience_s: float = 0.0) -> None:
        """Call ``write`` with the path, in a thread, as a disk that is busy holds no pose; not while one still runs.

        Parameters
        ----------
        write : replaces the file at a path
        patience_s : longest time to wait for its end [s]

        Raises
        ------
        InputError
            The file could not be written; raised once, and it is not written any more.
        """
        if self._fault is not None:
            self.active, fault, self._fault = False, self._fault, None
            raise fault
        if self.active and not self._writer.is_alive():
            self._writer = Thread(target=self._write, args=(write,), daemon=True)
            self._writer.start()
        if patience_s and self._writer.is_alive():
            self._writer.join(patience_s)

    def _write(self, write: Callable[[Path], None]) -> None:
        try:
            write(self.path)
        except InputError as error:
            self._fault = error

    def _forget(self) -> None:
        """Delete the file at the end of a flight: the next start is not in flight."""
        if self._writer.is_alive():
            self._writer.join()
        if self.active:
            # On a disk that became read-only the file stays; its age soon invalidates it.
            with suppress(OSError):
                self.path.unlink(missing_ok=True)
