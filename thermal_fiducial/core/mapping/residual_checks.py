"""What the residuals of a joint adjustment show beyond their size: errors that last, and duplicated markers.

Both work on whitened residuals (n, 8) of n views, ordered by time.
"""

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Longest correlation that is looked for [views of one marker].
_LONGEST = 100
# Outlying views of a marker, in number and as a share, of which something can be said; and the share of their squared
# error that one other pose must explain. Of ten views of noise six parameters explain 0.08; motion blur that lasts for
# some frames, 0.5.
_FEWEST, _LEAST, _EXPLAINED = 10, 0.1, 0.8


def correlation_time(residuals: FloatArray, marker: IntArray) -> float:
    """Views that say as much as one, 1 for white noise.

    Corner errors of a slow flight repeat themselves from frame to frame (of lag, optics, fixed pattern): N such views
    average as N / (1 + 2 sum rho_k) independent ones do, with rho_k the correlation at lag k (C. Geyer, "Practical
    Markov chain Monte Carlo", 1992). The sum ends where a correlation can no longer be distinguished from none.

    Parameters
    ----------
    residuals : (n, 8)
    marker : (n,) which one each shows
    """
    order = np.argsort(marker, kind='stable')
    r, marker = residuals[order], marker[order]
    power = float(np.mean(r * r)) if len(r) else 0.0
    total = 1.0
    for lag in range(1, min(_LONGEST, len(r))):
        same = marker[lag:] == marker[:-lag]
        count = 8 * np.count_nonzero(same)
        if not count or power == 0.0:
            break
        rho = float(np.sum(r[lag:][same] * r[:-lag][same])) / (count * power)
        if rho < 2.0 / np.sqrt(count):
            break
        total += 2.0 * rho
    return total


def two_places(residuals: FloatArray, J: FloatArray, outlying: BoolArray) -> bool:
    """Whether one other pose of a marker explains most of its outlying views: it was moved, or is there twice.

    Parameters
    ----------
    residuals, J : (n, 8), (n, 8, 6) of all views of one marker, J with respect to its pose
    outlying : (n,)
    """
    # A marker in the plane of a camera, of a map that has gone wrong, has no residual.
    outlying = outlying & np.isfinite(residuals).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
    count = np.count_nonzero(outlying)
    if count < _FEWEST or count < _LEAST * len(residuals):
        return False
    # Each view counts alike, however far off it is: the linear step is then good enough to decide.
    norms = np.linalg.norm(residuals[outlying], axis=-1)
    r = (residuals[outlying] / norms[:, None]).ravel()
    A = (J[outlying] / norms[:, None, None]).reshape(-1, 6)
    step, *_ = np.linalg.lstsq(A, r, rcond=None)
    left = r - A @ step
    return bool(left @ left < (1.0 - _EXPLAINED) * count)
