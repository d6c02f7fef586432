"""One row per marker: number of views, fit, state in the map and its reason."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.wording import number_of
from thermal_fiducial.report.map_error import marker_errors, MarkerError, sigmas
from thermal_fiducial.report.run_folder import Run

_ON_TRIAL, _QUARANTINED = 'candidates', 'quarantine'
QUARANTINED, FIXED = 'quarantined', 'fixed'


@dataclass(frozen=True)
class Tag:
    """Figures of a marker in a run; None: unknown."""

    id: int
    #: number of frames in which it was detected
    views: int
    first_view_ns: int | None
    corner_sigma_px: float | None
    residual_px: float | None
    sigma_mm: float | None
    sigma_deg: float | None
    status: str
    why: str
    error: MarkerError | None = None


def tags(run: Run) -> list[Tag]:
    """All markers of the map and of the detections, by ID."""
    known = {} if run.marker_map is None else run.marker_map.markers
    errors = {} if run.marker_map is None or run.true_map is None else marker_errors(run.marker_map, run.true_map)
    reasons = {name: _reasons(run, name) for name in (_ON_TRIAL, _QUARANTINED)}
    ids = sorted(set(known) | set(np.unique(run.detections.ids).tolist()))
    return [_tag(run, key, reasons, errors.get(key)) for key in ids]


def _tag(run: Run, key: int, reasons: dict[str, dict[int, str]], error: MarkerError | None) -> Tag:
    marker = None if run.marker_map is None else run.marker_map.markers.get(key)
    seen = run.detections.ids == key
    stamps = run.detections.stamps_ns[seen]
    status, why = _standing(run, key, len(stamps), reasons)
    sigma_mm, sigma_deg = (None, None) if marker is None else sigmas(marker)
    return Tag(
        id=key,
        views=len(np.unique(stamps)),
        first_view_ns=int(stamps.min()) if len(stamps) else None,
        corner_sigma_px=float(np.median(run.detections.sigma_px[seen])) if len(stamps) else None,
        residual_px=marker.reprojection_error_px if marker is not None and marker.observations else None,
        sigma_mm=sigma_mm,
        sigma_deg=sigma_deg,
        status=status,
        why=why,
        error=error,
    )


def _standing(run: Run, key: int, views: int, reasons: dict[str, dict[int, str]]) -> tuple[str, str]:
    marker = None if run.marker_map is None else run.marker_map.markers.get(key)
    localizing = run.summary.get('mode') == 'localization'
    if marker is None:
        if key in reasons[_ON_TRIAL]:
            return 'on trial', reasons[_ON_TRIAL][key]
        seen = f'seen in {number_of(views, "frame")}'
        return 'not in the map', 'no marker enters the map in this mode' if localizing else seen
    # The file of a map that stays as it is says nothing of what was found in this flight.
    if not marker.trusted or (localizing and key in reasons[_QUARANTINED]):
        return QUARANTINED, reasons[_QUARANTINED].get(key, 'contradicted the others')
    if marker.fixed:
        return FIXED, 'surveyed, never moves'
    if not views:
        return 'used', 'from an earlier run; not seen in this one'
    return 'used', f'{marker.observations} observations fit' if marker.observations else 'surveyed'


def _reasons(run: Run, name: str) -> dict[int, str]:
    """The mapper's last reason per marker, from its figures ``ID: reason; ID: reason``."""
    found: dict[int, str] = {}
    for node, figures in run.summary.get('diagnostics', {}).items():
        if node.rpartition('/')[2] == 'marker_mapper':
            for entry in str(figures.get(name, '')).split('; '):
                key, separator, reason = entry.partition(': ')
                if separator and key.isdigit():
                    found[int(key)] = reason
    return found
