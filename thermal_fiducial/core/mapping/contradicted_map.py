"""A map that most of its markers contradict: in other units, say, or of another place.

A robust pose follows those markers that are where the map has them. Where most are not, nothing says that the others
are: each of them may be what somebody has moved, and of a map in feet a marker alone fits as well as any other.
"""

import numpy as np

from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.mapping.located import Sight
from thermal_fiducial.core.mapping.map_data import NEW_FRAME_SHARE
from thermal_fiducial.core.types import BoolArray, FloatArray, TINY

#: Share of the last frames of a marker that counts as most of them.
MOST = 0.7
# Fewest markers against the map: of two that contradict each other odometry decides which has moved.
_FEWEST = 2
# Largest quartile deviation of the ratios of distances from their median, as a share of it, at which they are one
# ratio: markers of 20 px are as far away as they seem to a few per cent.
_ONE_RATIO = 0.1


class ContradictedMap:
    """Counts the markers that are where the map has them, and those that are not, by frames with two or more."""

    def __init__(self) -> None:
        # Shares by ID; both begin at 0, as a marker that was seen in a few frames counts for neither.
        self._agrees: dict[int, float] = {}
        self._contradicts: dict[int, float] = {}
        #: the likely cause, in words; empty while the map is not contradicted
        self.doubt = ''

    def add(self, sight: Sight, agrees: BoolArray) -> None:
        """Take in which (N,) of the known markers of a frame agree with its pose; none where no pose was found."""
        if len(agrees) < 2:
            return
        for key, good in zip(sight.observed.ids.tolist(), agrees.tolist(), strict=True):
            for shares, is_one in ((self._agrees, good), (self._contradicts, not good)):
                share = shares.get(key, 0.0)
                shares[key] = share + NEW_FRAME_SHARE * (is_one - share)
        right, wrong = (sum(share > MOST for share in shares.values()) for shares in (self._agrees, self._contradicts))
        if 2 * right > len(self._agrees):
            self.doubt = ''
        elif wrong >= _FEWEST and wrong > right and not self.doubt:
            self.doubt = _likely_cause(sight)


def most_px(sight: Sight) -> FloatArray:
    """Errors (N,) [px] up to which markers are where the map has them: half a side.

    Residuals widen what the pose claims: where none of the markers is in its place all agree with it.
    """
    return 0.5 * sides_px(sight.observed.corners)


def _likely_cause(sight: Sight) -> str:
    """By the distances between the markers of a frame: if all differ by one factor, it is the unit."""
    first, second = np.triu_indices(len(sight.sizes), 1)
    in_map, seen = (
        np.linalg.norm(centres[first] - centres[second], axis=-1)
        for centres in (sight.T_map_marker[:, :3, 3], sight.observed.branches[:, 0, :3, 3])
    )
    least, ratio, most = np.quantile(in_map / np.maximum(seen, TINY), [0.25, 0.5, 0.75])
    if most - least <= 2.0 * _ONE_RATIO * ratio and abs(ratio - 1.0) > _ONE_RATIO:
        return f'distances in the map are {float(f"{ratio:.3g}"):g} times those seen: is it in metres? marker_size?'
    return 'most markers are not where the map has them: is it of this place, in metres? calibration?'
