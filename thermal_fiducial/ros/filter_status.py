"""What a filter says of itself: diagnostics in words and numbers, and how often its pose has jumped."""

import re

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.innovations import INNOVATIONS, innovations_text, PoseUpdate
from thermal_fiducial.ros.node import ERROR, OK, WARN


class FilterStatus:
    """Watches ``filter_``."""

    def __init__(self, filter_: PoseEkf) -> None:
        self._filter = filter_
        #: how often the pose has jumped: starts, resets and corrections of the map
        self.jumps = 0
        self._resets: int | None = None
        self._last_refusal = ''
        #: stamps of the poses whose innovations were published
        self._published: set[int] = set()

    def after_imu(self) -> None:
        """Count a start or a reset."""
        resets = None if self._filter.state is None else self._filter.resets
        self.jumps += resets is not None and resets != self._resets
        self._resets = resets

    def after_pose(self, update: PoseUpdate) -> None:
        """Remember why a pose was refused, until one is not."""
        self._last_refusal = '' if update.accepted or update.pending else update.reason

    def state(self) -> tuple[bytes, str]:
        """Level, and in words what the filter does and why it refused the last pose."""
        status, lost = self._filter.status, self._filter.lost
        if self._last_refusal and not lost:
            return WARN, f'{status}; pose {self._last_refusal}'
        return ERROR if lost else OK if status == 'tracking' else WARN, status

    def headline(self) -> str:
        """What the filter does, without numbers."""
        return re.split(r'[:\d]', self._filter.status)[0].removesuffix(' for ')

    def figures(self) -> dict[str, object]:
        """The filter in numbers."""
        numbers: dict[str, object] = {name: f'{value:.6g}' for name, value in self._filter.diagnostics().items()}
        return numbers | {'lost': self._filter.lost, 'jumps': self.jumps, INNOVATIONS: self._innovations()}

    def _innovations(self) -> str:
        """Those of the poses since the last time."""
        decided = self._filter.decided
        text = innovations_text(update for stamp, update in decided.items() if stamp not in self._published)
        self._published = set(decided)
        return text
