"""What the entries of a map may be, in a file and in memory: without geometry, as the simulator writes maps, too."""

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Farthest coordinate of anything in a map [m]; single precision still resolves a centimetre there.
LARGEST_COORDINATE = 1e5
#: Tolerance of a covariance's symmetry and eigenvalues, relative to its largest element: rounding to so many.
_SIX_DIGITS = 1e-6


def fault_of_covariance(values: FloatArray) -> str:
    """Why ``values`` (n, n) of a map are no covariance, but for rounding to six digits; empty if they are one.

    Less is asked than of a measurement: an error may be zero, and maps are written by other hands.
    """
    scale = float(np.abs(values).max())
    if not scale < LARGEST_COORDINATE**2:
        return 'not finite, or too large'
    if np.abs(values - values.T).max() > _SIX_DIGITS * scale:
        return 'not symmetric'
    return 'has a negative variance' if np.linalg.eigvalsh(values)[0] < -_SIX_DIGITS * scale else ''
