"""Noise densities of an IMU at rest from its Allan deviation.

IEEE Std 952-1997, annex C: with white noise N, bias instability B and random walk K, the Allan variance at averaging
time tau is ``N^2 / tau + B^2 2 ln 2 / pi + K^2 tau / 3``; all three are fitted to it at octaves of tau.
"""

from dataclasses import dataclass

import allantools
import numpy as np
from scipy.optimize import nnls

from thermal_fiducial.calibration.preintegration import ImuTrack
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

#: Shortest usable recording [s].
SHORTEST_S = 20.0
# Largest deviation of one-second averages at rest [rad/s, m/s^2]: a table that somebody leans on.
_STILL = np.repeat((0.02, 0.2), 3)
# Longest averaging time as a share of the recording; longer ones leave too few averages.
_LONGEST_SHARE = 0.1
# Largest tolerated share of time in gaps, and shortest interval that counts as a gap [s].
_MISSING, _GAP_S = 0.02, 0.2
_FLICKER = 2.0 * np.log(2.0) / np.pi


@dataclass(frozen=True)
class AllanFit:
    """Allan deviation of one sensor, three axes, with its fit.

    Parameters
    ----------
    tau : (K,) averaging times [s]
    deviation : (K, 3) overlapping Allan deviation
    white : (3,) density N, per sqrt(Hz)
    instability : (3,) bias instability B
    walk : (3,) density K, per second and sqrt(Hz)
    """

    tau: FloatArray
    deviation: FloatArray
    white: FloatArray
    instability: FloatArray
    walk: FloatArray


@dataclass(frozen=True)
class ImuNoiseFit:
    """Gyroscope in rad/s, accelerometer in m/s^2."""

    seconds: float
    rate_hz: float
    gyroscope: AllanFit
    accelerometer: AllanFit


def fit_noise(track: ImuTrack) -> ImuNoiseFit:
    """Densities of an IMU at rest.

    Raises
    ------
    InputError
        A recording that is too short, not at rest, or has too many missing samples, or an axis that never changes.
    """
    seconds = float(track.seconds[-1] - track.seconds[0])
    if seconds < SHORTEST_S:
        raise InputError(f'{seconds:.1f} s are too short for an Allan deviation: at least {SHORTEST_S:.0f} s at rest')
    intervals = np.diff(track.seconds)
    # The mean, not the median: a driver may stamp its samples in bursts.
    rate = len(intervals) / seconds
    gaps = float(np.sum(intervals[intervals > _GAP_S])) / seconds
    if gaps > _MISSING:
        raise InputError(f'IMU samples are missing for {100.0 * gaps:.0f} % of the time')
    values = np.hstack([track.rate, track.force])
    _check_rest(values, rate)
    track.require_signals()
    return ImuNoiseFit(seconds, rate, _fit(values[:, :3], rate, seconds), _fit(values[:, 3:], rate, seconds))


def _check_rest(values: FloatArray, rate: float) -> None:
    window = max(round(rate), 1)
    count = len(values) // window
    means = values[: count * window].reshape(count, window, 6).mean(axis=1)
    off = np.abs(means - np.median(means, axis=0)) / _STILL
    if off.max() > 1.0:
        second, axis = np.unravel_index(int(np.argmax(off)), off.shape)
        name = ('gyroscope', 'accelerometer')[int(axis) // 3] + ' ' + 'xyz'[int(axis) % 3]
        raise InputError(f'the IMU is not at rest: its {name} changes at {second} s')


def _fit(values: FloatArray, rate: float, seconds: float) -> AllanFit:
    """Fit N, B and K to samples (N, 3)."""
    longest = max(1, int(np.log2(_LONGEST_SHARE * seconds * rate)))
    wanted = 2.0 ** np.arange(longest + 1) / rate
    columns = [allantools.oadev(axis, rate=rate, data_type='freq', taus=wanted)[:2] for axis in values.T]
    tau = columns[0][0]
    deviation = np.stack([column[1] for column in columns], axis=1)
    design = np.stack([1.0 / tau, np.full(len(tau), _FLICKER), tau / 3.0], axis=1)
    fitted = []
    for variance in (deviation**2).T:
        # The relative standard deviation of an Allan variance is about one over the root of the number of averages.
        weight = np.sqrt(seconds / tau) / np.maximum(variance, 1e-6 * np.max(variance))
        fitted.append(np.sqrt(nnls(design * weight[:, None], variance * weight)[0]))
    white, instability, walk = np.array(fitted).T
    return AllanFit(tau, deviation, white, instability, walk)
