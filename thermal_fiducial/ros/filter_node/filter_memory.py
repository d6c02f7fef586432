"""Restart after a crash in flight: the filter's clock offset, saved to a file once a second."""

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.hypotheses import KNOWN_OFFSET_STD
from thermal_fiducial.files.clock_offset import recent_clock_offset, save_clock_offset
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.base.restart_memory import RestartMemory


class FilterMemory:
    """Saves the clock offset, and starts with the one that a crashed filter of the same name left; only in live nodes.

    Parameters
    ----------
    node : the filter's node, whose config takes over the saved clock offset
    """

    def __init__(self, node: StageNode[PoseEkfConfig]) -> None:
        config = node.config
        self._memory = RestartMemory(node, active=node.live and config.resume and config.estimate_time_offset)
        offset = recent_clock_offset(self._memory.path) if self._memory.active else None
        if offset is not None:
            node.derive(camera_time_offset=offset, time_offset_std=min(config.time_offset_std, KNOWN_OFFSET_STD))
            line = f'started again in flight: the clock offset of {1e3 * offset:.1f} ms is kept'
            node.get_logger().warning(line)

    def save(self, filter_: PoseEkf) -> None:
        """Save the clock offset for a restart, once it is known.

        Raises
        ------
        InputError
            The file could not be written; raised once.
        """
        offset = filter_.camera_time_offset
        if not filter_.lost and offset is not None:
            self._memory.save(lambda path: save_clock_offset(path, offset))
