"""Pose of a landing pad: one marker of the map, or a group of them."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from thermal_fiducial.config import LandingTargetConfig
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.types import FloatArray

#: mavros applies the ENU to NED conversion (x, y, z) -> (y, x, -z) in every frame. Given right-forward-up axes it
#: yields forward-right-down, so forward-left-up is turned by 90 degrees first.
_T_RFU_FLU = transform([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.zeros(3))


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
