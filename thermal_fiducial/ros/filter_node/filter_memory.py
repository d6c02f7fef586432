"""Restart after a crash in flight: the filter's clock offset, saved to a file once a second."""

from contextlib import suppress
import os
from threading import Thread

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.hypotheses import KNOWN_OFFSET_STD
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.clock_offset import recent_clock_offset, save_clock_offset
from thermal_fiducial.files.robot_folder import robot_folder
from thermal_fiducial.ros.base.node import StageNode


class FilterMemory:
    """Saves the clock offset, and starts with the one that a crashed filter of the same name left; only in live nodes.

    Parameters
    ----------
    node : the filter's node, whose config takes over the saved clock offset
    """

    def __init__(self, node: StageNode[PoseEkfConfig]) -> None:
        config = node.config
        self._active = node.live and config.resume and config.estimate_time_offset
        name = node.get_fully_qualified_name().strip('/').replace('/', '_')
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        self._path = robot_folder() / f'{name}_{domain}.json'
        # That of the last save; the first one never runs.
        self._writer = Thread()
        #: why the last save failed, until that is reported
        self._fault: InputError | None = None
        node.completions.append(self._forget)
        offset = recent_clock_offset(self._path) if self._active else None
        if offset is not None:
            node.derive(camera_time_offset=offset, time_offset_std=min(config.time_offset_std, KNOWN_OFFSET_STD))
            line = f'started again in flight: the clock offset of {1e3 * offset:.1f} ms is kept'
            node.get_logger().warning(line)

    def save(self, filter_: PoseEkf) -> None:
        """Save the clock offset for a restart, once it is known; in a thread, as a disk that is busy holds no pose.

        Raises
        ------
        InputError
            The file could not be written; raised once.
        """
        if self._fault is not None:
            self._active, fault, self._fault = False, self._fault, None
            raise fault
        offset = filter_.camera_time_offset
        if self._active and not filter_.lost and offset is not None and not self._writer.is_alive():
            self._writer = Thread(target=self._write, args=(offset,), daemon=True)
            self._writer.start()

    def _write(self, offset: float) -> None:
        try:
            save_clock_offset(self._path, offset)
        except InputError as error:
            self._fault = error

    def _forget(self) -> None:
        """Delete the file at the end of a flight: the next start is not in flight."""
        if self._writer.is_alive():
            self._writer.join()
        if self._active:
            # On a disk that became read-only the file stays; its age soon invalidates it.
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
