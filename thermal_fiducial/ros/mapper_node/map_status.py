"""Status of the mapper: diagnostics and console lines."""

from collections import deque
import math
from statistics import median

import numpy as np

from thermal_fiducial.core.mapping.located import error_std_px, LocatedFrame
from thermal_fiducial.core.mapping.map_data import MapperResult, MarkerMap
from thermal_fiducial.core.wording import listed
from thermal_fiducial.ros.base.node import OK, WARN

#: Covariance of a camera that is taken as it is.
_EXACT = np.zeros((6, 6))
#: Frames whose residuals are judged together: motion blur lasts for less.
_FRAMES = 30
#: Residuals [standard deviations] that neither map nor corners explain: of rigs as declared they are up to 0.4, of
#: recorded flights up to 0.84, of a surveyed map good to 20 mm 0.86, by 2 % of the focal length 1.7.
_MISFIT = 1.5


class Misfit:
    """How far corners are off the known markers of the map in most of the latest frames.

    Covariances are scaled to the residuals, but a wrong calibration or map moves the camera by far more than these
    show: 2 % of the focal length by 64 mm at a claim of 6 mm, 10 % by 0.3 m at 16 mm.
    """

    def __init__(self) -> None:
        self._squares: deque[float] = deque(maxlen=_FRAMES)

    def add(self, frame: LocatedFrame) -> None:
        """Take in a frame, if a pose was found, be it one of two, or one with markers behind the camera."""
        if frame.outcome.compared is not None:
            sight, reprojection = frame.outcome.compared
            ratios = reprojection.errors_px / error_std_px(sight, reprojection, _EXACT)
            self._squares.append(float(np.nan_to_num(ratios @ ratios, nan=math.inf)) / len(ratios))

    @property
    def sigma(self) -> float:
        """Rms over markers, median over frames [standard deviations of map and corners]; 0 until there are enough."""
        return math.sqrt(median(self._squares)) if len(self._squares) == _FRAMES else 0.0

    @property
    def doubt(self) -> str:
        """Warning for diagnostics and console; empty if corners and map fit."""
        if self.sigma < _MISFIT:
            return ''
        return 'corners are not where map and calibration have them: calibration, sides of the markers, map?'


def state(result: MapperResult, doubts: str, *, frozen: bool, left: int = 0) -> tuple[bytes, str]:
    """Diagnostic level and message: why the last frame gave no pose, doubts about the map, quarantined markers.

    ``left``: frames skipped for newer ones since the last call.
    """
    if result.reason or doubts:
        return WARN, '; '.join(filter(None, (result.reason, doubts)))
    if result.quarantined:
        return WARN, f'quarantined: {listed(result.quarantined)}'
    if left:
        return WARN, f'{left} older frames skipped'
    return OK, 'map frozen' if frozen else 'ok'


def figures(marker_map: MarkerMap, corrections: int, result: MapperResult, misfit: float) -> dict[str, object]:
    """Key-value pairs of the diagnostics: size of the map, candidates, reasons of quarantines."""
    return {
        'markers in map': len(marker_map.markers),
        'map revision': marker_map.revision,
        'map corrections': corrections,
        'misfit [sigma]': f'{misfit:.2f}',
        'in view': listed(sorted(result.in_view)),
        'quarantined': listed(result.quarantined),
        'quarantine': '; '.join(f'{key}: {why}' for key, why in sorted(result.quarantine_reasons.items())),
        'candidates': '; '.join(f'{key}: {reason}' for key, reason in result.candidates.items()),
    }


def news(before: MapperResult, now: MapperResult) -> dict[int, str]:
    """Console line by marker ID: quarantined, with the reason, or trusted again."""
    new = set(now.quarantined) - set(before.quarantined)
    into = {key: f'marker {key} quarantined: {now.quarantine_reasons[key]}' for key in sorted(new)}
    out = {key: f'marker {key} is trusted again' for key in before.quarantined if key not in now.quarantined}
    return into | out
