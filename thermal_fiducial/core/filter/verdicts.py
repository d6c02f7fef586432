"""Verdicts on poses, as the filter logs them."""

from dataclasses import dataclass
from itertools import islice
import math

import numpy as np

#: Verdicts kept, and poses over which the diagnostics average the normalised innovation squared (NIS).
_KEPT, _NIS_POSES = 300, 30


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """Verdict on a camera pose."""

    #: stamp of the camera, as it came
    stamp_ns: int
    #: whether it moved the estimate
    accepted: bool
    #: in words; empty when accepted, except for the pose that initialised or reset the filter
    reason: str
    #: squared Mahalanobis distance (6 degrees of freedom), NaN where there was nothing to compare with
    nis: float
    #: whether it waits for the IMU samples of its instant; the final word is in ``PoseEkf.decided``
    pending: bool = False

    @property
    def refused(self) -> bool:
        """Whether it was compared with the estimate and found beyond the gate."""
        return not self.accepted and not math.isnan(self.nis)


class PoseLog:
    """The latest verdicts, in the order in which they were given, and the numbers of accepted and refused poses."""

    def __init__(self) -> None:
        #: stamp of the camera to the latest verdict on its pose
        self.latest: dict[int, PoseUpdate] = {}
        self.accepted = self.refused = 0

    def add(self, update: PoseUpdate) -> None:
        """Log a verdict; a pose that is applied again after a late one counts once."""
        if self.latest.pop(update.stamp_ns, None) is None:
            self.accepted += update.accepted
            self.refused += update.refused
        self.latest[update.stamp_ns] = update
        if len(self.latest) > _KEPT:
            del self.latest[next(iter(self.latest))]

    def mean_nis(self) -> float:
        """Mean NIS per degree of freedom of the latest accepted poses: 1 is consistent, less conservative."""
        latest = islice(reversed(self.latest.values()), _NIS_POSES)
        values = [update.nis / 6.0 for update in latest if update.accepted and not math.isnan(update.nis)]
        return float(np.mean(values or math.nan))
