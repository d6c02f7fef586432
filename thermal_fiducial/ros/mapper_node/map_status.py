"""Status of the mapper: diagnostics and console lines."""

from collections.abc import Iterable

from thermal_fiducial.core.mapping.map_data import MapperResult, MarkerMap
from thermal_fiducial.ros.base.node import OK, WARN


def state(result: MapperResult, doubts: str, *, frozen: bool, left: int = 0) -> tuple[bytes, str]:
    """Diagnostic level and message: why the last frame gave no pose, doubts about the map, quarantined markers.

    ``left``: frames skipped for newer ones since the last call.
    """
    if result.reason or doubts:
        return WARN, '; '.join(filter(None, (result.reason, doubts)))
    if result.quarantined:
        return WARN, f'quarantined: {_listed(result.quarantined)}'
    if left:
        return WARN, f'{left} older frames skipped'
    return OK, 'map frozen' if frozen else 'ok'


def figures(marker_map: MarkerMap, corrections: int, result: MapperResult) -> dict[str, object]:
    """Key-value pairs of the diagnostics: size of the map, candidates, reasons of quarantines."""
    return {
        'markers in map': len(marker_map.markers),
        'map revision': marker_map.revision,
        'map corrections': corrections,
        'in view': _listed(sorted(result.in_view)),
        'quarantined': _listed(result.quarantined),
        'quarantine': '; '.join(f'{key}: {why}' for key, why in sorted(result.quarantine_reasons.items())),
        'candidates': '; '.join(f'{key}: {reason}' for key, reason in result.candidates.items()),
    }


def news(before: MapperResult, now: MapperResult) -> dict[int, str]:
    """Console line by marker ID: quarantined, with the reason, or trusted again."""
    new = set(now.quarantined) - set(before.quarantined)
    into = {key: f'marker {key} quarantined: {now.quarantine_reasons[key]}' for key in sorted(new)}
    out = {key: f'marker {key} is trusted again' for key in before.quarantined if key not in now.quarantined}
    return into | out


def _listed(ids: Iterable[int]) -> str:
    return ', '.join(str(key) for key in ids)
