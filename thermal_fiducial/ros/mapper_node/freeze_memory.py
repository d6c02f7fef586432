"""Restart after a crash in flight: whether ``~/freeze`` has frozen the map or set it free."""

from pathlib import Path
from typing import Any

from thermal_fiducial.files.restart_file import recent_values, save_for_restart
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.base.restart_memory import RestartMemory

_KIND, _FROZEN = 'freeze', 'frozen'
#: Longest time for which the service waits for the disk [s], three frames: no frame is processed meanwhile.
_PATIENCE_S = 0.1


class FreezeMemory:
    """Saves what was asked of ``~/freeze``; the next mapper of this name begins with it after a crash.

    Parameters
    ----------
    node : the mapper's node; only a live one is started again
    """

    def __init__(self, node: StageNode[Any]) -> None:
        self._memory, self._logger = RestartMemory(node, active=node.live), node.get_logger()
        found = recent_values(self._memory.path, _KIND).get(_FROZEN) if node.live else None
        #: whether the service has frozen the map or set it free, in this flight; None: nobody has called it
        self.asked: bool | None = found if isinstance(found, bool) else None

    def recalled(self, by_mode: bool) -> bool:
        """Whether the map is frozen: as before the crash, else ``by_mode``."""
        if self.asked is None:
            return by_mode
        self._logger.warning(f'started again in flight: the map is {"frozen" if self.asked else "free"} as before')
        return self.asked

    def ask(self, frozen: bool) -> None:
        """Take note of what the service is asked, and save it at once: a mapper that crashes next has it in its file.

        Raises
        ------
        InputError
            As :meth:`save`.
        """
        self.asked = frozen
        self._memory.save(self._write, _PATIENCE_S)

    def save(self) -> None:
        """Refresh what was saved, so that it stays recent, once the service was called.

        Raises
        ------
        InputError
            The file could not be written; raised once.
        """
        if self.asked is not None:
            self._memory.save(self._write)

    def _write(self, path: Path) -> None:
        # Again if the service is called meanwhile: no other thread writes until this one has ended.
        written = None
        while written != self.asked:
            written = self.asked
            save_for_restart(path, _KIND, {_FROZEN: written})
