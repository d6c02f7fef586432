"""Pose of a landing pad: one marker of the map, or a group of them."""

from collections import deque
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from thermal_fiducial.config import LandingTargetConfig
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.types import FloatArray

#: mavros applies the ENU to NED conversion (x, y, z) -> (y, x, -z) in every frame. Given right-forward-up axes it
#: yields forward-right-down, so forward-left-up is turned by 90 degrees first.
_T_RFU_FLU = transform([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.zeros(3))

_WAITING = 10  # most frames waiting for their camera pose: a third of a second


class WaitingFrames:
    """Frames that show the pad and have no camera pose so far."""

    def __init__(self) -> None:
        # Stamp of each, and whether its pad was sent without a pose.
        self._frames: deque[tuple[int, bool]] = deque(maxlen=_WAITING)

    @property
    def stalled(self) -> bool:
        """Whether they get no camera poses."""
        return len(self._frames) == _WAITING

    def add(self, stamp_ns: int, *, sent: bool) -> None:
        """A frame that shows the pad; ``sent``: without waiting for its pose."""
        self._frames.append((stamp_ns, sent))

    def take(self, stamp_ns: int) -> bool:
        """End the wait of a frame that has a pose, and of those before it; whether its pad is to be sent.

        Not when it was sent, or that of a newer frame, before poses came again.
        """
        stamps = [stamp for stamp, _ in self._frames]
        if stamp_ns not in stamps:
            return False
        overtaken = False
        for _ in range(stamps.index(stamp_ns) + 1):
            _, overtaken = self._frames.popleft()
        return not (overtaken or any(sent for _, sent in self._frames))


def pad_in_map(T_map_markers: Mapping[int, FloatArray], pad_ids: Sequence[int]) -> FloatArray | None:
    """T_map_pad (4, 4): origin at the centroid of the pad's markers, axes of the first; None if one is not mapped.

    Parameters
    ----------
    T_map_markers : ID to T_map_marker (4, 4) of the map
    pad_ids : markers of the pad
    """
    poses = [T_map_markers[marker_id] for marker_id in pad_ids if marker_id in T_map_markers]
    if not poses or len(poses) < len(pad_ids):
        return None
    T_map_pad = poses[0].copy()
    T_map_pad[:3, 3] = np.mean([T[:3, 3] for T in poses], axis=0)
    return T_map_pad


def needs_no_map(config: LandingTargetConfig) -> bool:
    """Whether a single marker's detection gives the pad's pose: one marker, output in the body frame."""
    return len(config.landing_pad) == 1 and config.landing_target_frame == 'body'


def what_lacks(pad_ids: Sequence[int], mapped: Collection[int], quarantined: Collection[int]) -> str:
    """Which markers of the pad the map lacks, those in its quarantine included."""
    why = {key: 'in quarantine' if key in mapped else 'missing' for key in pad_ids}
    lacking = [f'marker {key} {why[key]}' for key in pad_ids if key not in mapped or key in quarantined]
    return f'the pad is not in the map: {", ".join(lacking)}'


def for_mavros(T_body_pad: FloatArray) -> FloatArray:
    """T_rfu_pad (4, 4), which mavros converts to the pad in the robot's forward-right-down frame (BODY_FRD)."""
    return np.asarray(_T_RFU_FLU @ T_body_pad)


def from_mavros(positions: FloatArray) -> FloatArray:
    """Inverse of :func:`for_mavros` for positions (N, 3) [m]: right-forward-up to ``base_link``."""
    return positions @ _T_RFU_FLU[:3, :3]
