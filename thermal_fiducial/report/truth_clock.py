"""Clock of the ground truth against that of the run: a tracker's computer has its own."""

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.report.metrics import aligned_residuals, Errors, errors, rms
from thermal_fiducial.report.trajectory import Trajectory

#: Offsets that are tried: up to the largest in coarse steps, then about the best of them in fine ones [ns]. Computers
#: that are not synchronised are a second or two apart; in a coarse step a drone keeps its velocity.
_LARGEST_NS, _COARSE_NS, _FINE_NS = 2 * SECOND_NS, SECOND_NS // 50, SECOND_NS // 1000
#: Least offset that is named [ns]: synchronised computers differ by a few milliseconds, and those hardly matter.
_LEAST_NS = 5 * _FINE_NS
#: Most and fewest poses that are compared, evenly over the run (the fewest are a second at 10 Hz), and the least share
#: of them that must have a truth with any offset.
_POSES, _FEWEST, _LEAST_SHARE = 300, 10, 0.7
#: How many times closer the positions must come. In the right clock, errors of the run remain whatever is added.
_TIMES_CLOSER = 3.0


def doubt_of_clock(found: Errors, truth: Trajectory) -> str:
    """That the clock of the truth is another one, and by how much, in words; empty if it seems to be the run's.

    Positions are compared after a rigid alignment: a truth in another frame is no truth in another clock.

    Parameters
    ----------
    found : errors of a run's poses against ``truth`` as it is
    """
    if len(found) < _FEWEST:
        return ''
    some = np.linspace(0, len(found) - 1, min(len(found), _POSES)).astype(np.int64)
    poses = Trajectory(found.stamps_ns[some], found.estimate[some])
    as_it_is = _residuals(poses, truth, np.zeros(1, np.int64))[0]
    best = 0
    for reach, step in ((_LARGEST_NS, _COARSE_NS), (_COARSE_NS, _FINE_NS)):
        tried = best + np.arange(-reach, reach + step, step)
        residuals = _residuals(poses, truth, tried)
        best = int(tried[np.argmin(residuals)])
    if abs(best) < _LEAST_NS or as_it_is < _TIMES_CLOSER * residuals.min():
        return ''
    closer = f'{1e3 * residuals.min():.3g} instead of {1e3 * as_it_is:.3g} mm off, after rigid alignment'
    added = f'With {best / SECOND_NS:+.3f} s added to its stamps'
    return f'{added} the ground truth is {closer}: its clock is not that of the IMU.'


def _residuals(poses: Trajectory, truth: Trajectory, offsets_ns: IntArray) -> FloatArray:
    """Rms (K,) [m] with each offset added to the stamps of the truth; infinite where there is too little truth."""
    found = [errors(Trajectory(poses.stamps_ns - offset, poses.T_map_body), truth) for offset in offsets_ns]
    least = _LEAST_SHARE * len(poses)
    return np.array([rms(np.linalg.norm(aligned_residuals(e), axis=1)) if len(e) >= least else np.inf for e in found])
