"""Status of the filter: diagnostics, console lines, count of jumps of the pose."""

from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.output import TRACKING, WAITING
from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.files.innovations import INNOVATIONS, innovations_text, LAST_REFUSED
from thermal_fiducial.ros.base.console import Console
from thermal_fiducial.ros.base.node import ERROR, OK, WARN
from thermal_fiducial.ros.filter_node.imu_queue import ImuQueue

#: Difference of IMU and pose stamps beyond any delay [s]: their clocks are not synchronised.
_APART_S = 2.5


class FilterStatus:
    """Monitors ``filter_`` and the delay of its input ``imu``; resets are printed on ``console``."""

    def __init__(self, filter_: PoseEkf, imu: ImuQueue, console: Console) -> None:
        self._filter, self._imu, self._console = filter_, imu, console
        #: number of jumps of the pose: initialisations, resets, corrections of the map
        self.jumps = 0
        self._resets: int | None = None
        #: last status without numbers, last headline, whether the pose was lost then, whether ever initialised
        self._words, self._headline, self._was_lost, self._initialised = '', '', True, False
        self._last_refusal = ''
        #: stamp of the latest IMU sample; None before the first
        self._imu_ns: int | None = None
        #: stamp of the latest camera pose less that of the IMU sample before it [s]
        self._apart_s = 0.0
        #: stamps of poses whose innovations have been published
        self._published: set[int] = set()

    def after_imu(self, stamp_ns: int) -> None:
        """Count a start or a reset."""
        self._imu_ns = stamp_ns
        resets = None if self._filter.estimate is None else self._filter.resets
        if resets == self._resets:
            return
        self.jumps += resets is not None
        if self._resets is not None:
            self._console.event('reset', f'reset: {self._filter.reset_reason}')
        self._resets = resets

    def after_pose(self, update: PoseUpdate) -> None:
        """Keep the reason of the last refusal until a pose is accepted."""
        if self._imu_ns is not None:
            self._apart_s = (update.stamp_ns - self._imu_ns) / SECOND_NS
        self._last_refusal = '' if update.accepted or update.pending else update.reason

    def state(self, doubt: str) -> tuple[bytes, str]:
        """Diagnostic level and message: state of the filter, reason of the last refusal, delay, ``doubt`` of frames."""
        level, words = self._state_of_filter()
        off = '; '.join(map(str, self._filter.doubts))
        level = max(level, self._imu.level(), WARN if doubt or off else OK)
        return level, _joined(_joined(_joined(words, self._imu.complaint()), off), doubt)

    def _state_of_filter(self) -> tuple[bytes, str]:
        condition, lost = self._condition(), self._filter.lost
        if self._last_refusal and (not lost or condition == WAITING):
            return ERROR if lost else WARN, f'{condition}; pose {self._last_refusal}'
        return ERROR if lost else OK if condition == TRACKING else WARN, str(condition)

    def headline(self) -> str:
        """State of the filter without numbers, with the reason of a reset when it has a pose again."""
        words, lost = self._condition().words, self._filter.lost
        if words != self._words:
            again = 'recovered' if self._initialised else 'initialised'
            self._headline = f'{again}: {words}' if self._was_lost and not lost else words
            self._words, self._was_lost = words, lost
            self._initialised |= not lost
        off = '; '.join(doubt.words for doubt in self._filter.doubts)
        return _joined(_joined(self._headline, self._imu.headline()), off)

    def _condition(self) -> Condition:
        """Condition of the filter; where it lacks poses because their clock is not the IMU's, that."""
        condition = self._filter.condition
        if condition != WAITING or abs(self._apart_s) < _APART_S:
            return condition
        side = 'ahead of' if self._apart_s > 0.0 else 'behind'
        return Condition('camera and IMU have two clocks', f'poses are {abs(self._apart_s):.4g} s {side} the IMU')

    def figures(self) -> dict[str, object]:
        """Key-value pairs of the diagnostics."""
        numbers: dict[str, object] = {name: f'{value:.6g}' for name, value in self._filter.diagnostics().items()}
        own = {'lost': self._filter.lost, 'jumps': self.jumps, INNOVATIONS: self._innovations()}
        return numbers | own | {LAST_REFUSED: self._last_refusal, 'IMU messages without a pose': self._imu.without_pose}

    def _innovations(self) -> str:
        """Innovations of the poses since the last call."""
        decided = self._filter.decided
        text = innovations_text(update for stamp, update in decided.items() if stamp not in self._published)
        self._published = set(decided)
        return text


def _joined(words: str, more: str) -> str:
    return f'{words}; {more}' if more else words
