"""Plausibility checks of a map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from thermal_fiducial.core.geometry.se3 import turn_between
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.wording import marker_names

#: Re-projection error of a marker above which some views are outliers [px]; these have little weight in its pose.
LARGE_PX = 2.0
#: Re-projection error [px] that nearly all markers exceed only with a common cause, a wrong calibration. OpenCV's
#: corners are accurate to 0.2 px in photos, those of this package to 0.03 px in counts; ignored distortion left 0.4.
ALL_LARGE_PX = 0.3
# Share of the markers that counts as nearly all, and fewest markers for that verdict.
_NEARLY_ALL, _FEW = 0.9, 3
_WIDE_M = 0.1
# Distance from the origin beyond which a position is probably in millimetres [m].
_FAR_M = 1000.0
# Distance from which a marker is seen at most, in its sides: 12 px (`min_side_px`) of 0.017 mm behind a lens of 100 mm,
# the longest of a Tau 2.
_SEEN_FROM = 500.0
# Most IDs that a line names.
_MOST_NAMES = 5


class Doubt(NamedTuple):
    """A message, and whether poses from the map are less accurate than their covariance says."""

    text: str
    spoils: bool


def doubts(marker_map: MarkerMap) -> list[Doubt]:
    """Doubts about a map; empty if it is plausible."""
    markers = [marker_map.markers[key] for key in sorted(marker_map.markers)]
    if not markers:
        return [Doubt('the map has no marker', True)]
    found = []
    if not any(m.fixed for m in markers):
        found.append(Doubt('no marker is fixed: a refinement has nothing to hold on to', False))
    for m in markers:
        found += _doubts_of(m)
    return [*found, *_overlaps(markers), *_far_groups(markers), *_calibration(markers)]


def _doubts_of(marker: MapMarker) -> list[Doubt]:
    found = []
    sigma = float(np.sqrt(max(np.trace(marker.covariance[:3, :3]), 0.0)))
    if not marker.trusted:
        found.append(('in quarantine, it disagrees with the others', False))
    if (far := float(np.linalg.norm(marker.T_map_marker[:3, 3]))) > _FAR_M:
        found.append((f'{far:.0f} m from the origin: positions are in metres', False))
    if sigma > _WIDE_M:
        found.append((f'known to {sigma:.2f} m only', False))
    if marker.reprojection_error_px > LARGE_PX:
        found.append((f're-projection error {marker.reprojection_error_px:.1f} px', False))
    if not marker.fixed and not np.any(marker.covariance):
        found.append(('neither fixed nor with a covariance: it is taken for exact', True))
    return [Doubt(f'marker {marker.id}: {text}', spoils) for text, spoils in found]


def _overlaps(markers: Sequence[MapMarker]) -> list[Doubt]:
    found = []
    centres, sizes = np.stack([m.T_map_marker[:3, 3] for m in markers]), np.array([m.size for m in markers])
    for i, m in enumerate(markers):
        near = np.linalg.norm(centres[i + 1 :] - centres[i], axis=-1)
        # Half of the distance at which squares cover each other however they are turned.
        for j in np.flatnonzero(near < 0.25 * (m.size + sizes[i + 1 :])).tolist():
            other = markers[i + 1 + j]
            facing = turn_between(m.T_map_marker, other.T_map_marker)
            apart = f'{near[j]:.3f} m and {np.rad2deg(float(facing)):.0f} deg apart'
            found.append(Doubt(f'markers {m.id} and {other.id} overlap: {apart}', m.trusted and other.trusted))
    return found


def _far_groups(markers: Sequence[MapMarker]) -> list[Doubt]:
    """Groups of markers, but for the largest, so far from all others that no camera sees some of both."""
    centres, reach = (
        np.stack([m.T_map_marker[:3, 3] for m in markers]),
        _SEEN_FROM * np.array([m.size for m in markers]),
    )
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    count, groups = connected_components(apart <= reach[:, None] + reach)
    found = []
    for group in set(range(count)) - {int(np.argmax(np.bincount(groups)))}:
        inside = groups == group
        ids = [markers[k].id for k in np.flatnonzero(inside).tolist()]
        names = marker_names(ids, _MOST_NAMES)
        far = float(apart[inside][:, ~inside].min())
        found.append(
            Doubt(f'{names}: {far:.0f} m from all others, no camera sees both: positions are in metres', False)
        )
    return found


def _calibration(markers: Sequence[MapMarker]) -> list[Doubt]:
    errors = [m.reprojection_error_px for m in markers if m.trusted and m.reprojection_error_px > 0.0]
    if len(errors) < _FEW or (least := float(np.quantile(errors, 1.0 - _NEARLY_ALL))) < ALL_LARGE_PX:
        return []
    text = f'nearly all markers have re-projection errors of {least:.1f} px or more: the likely cause is a calibration'
    return [Doubt(f'{text} that is wrong or belongs to another camera, lens or image size', False)]
