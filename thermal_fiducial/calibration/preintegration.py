"""Preintegrated IMU samples between camera frames: rotation, velocity and position increments with covariances.

C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, "On-manifold preintegration for real-time visual-inertial
odometry", 2017, section VI, for all intervals at once.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.imu_noise import bias_walks
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

# Longest step of the integration [s]: the sampling interval of a 200 Hz IMU.
_STEP = 0.005
#: Number of scale errors and misalignments of an IMU, and of those of its gyroscope, which are the first.
AXES, GYROSCOPE_AXES = 15, 9
# Interval between samples [s] from which on motion is not linear in it: interpolated over 0.1 s it moves no answer by a
# fifth of its error, over 0.2 s by all of it.
_GAP = 0.1
# Variance of the second difference of white noise of variance one.
_SECOND_DIFFERENCE = 6.0


@dataclass(frozen=True)
class SampleNoise:
    """Noise densities of recorded samples, as in :class:`ImuNoise`; vibration may exceed what any IMU has at rest."""

    gyroscope_noise_density: float
    accelerometer_noise_density: float
    gyroscope_random_walk: float
    accelerometer_random_walk: float


#: Noise densities as they are declared, or as recorded samples show them.
Densities: TypeAlias = ImuNoise | SampleNoise


@dataclass(frozen=True)
class ImuTrack:
    """Samples (N,) in the IMU's clock.

    Parameters
    ----------
    seconds : (N,) increasing
    rate : (N, 3) angular velocity [rad/s]
    force : (N, 3) specific force [m/s^2]
    """

    seconds: FloatArray
    rate: FloatArray
    force: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rate and force (..., 3) at times ``t``, linear between samples."""
        return self._interpolated(self.rate, t), self._interpolated(self.force, t)

    def slope_at(self, t: FloatArray) -> FloatArray:
        """Derivative (..., 3) of the specific force at times ``t`` [m/s^3]."""
        return self._interpolated(self.force_slope, t)

    def _interpolated(self, signal: FloatArray, t: FloatArray) -> FloatArray:
        return np.stack([np.interp(t, self.seconds, signal[:, axis]) for axis in range(3)], axis=-1)

    def hidden(self, t: FloatArray) -> FloatArray:
        """Noise densities (N, 6), squared, of what samples are interpolated over at times ``t`` (N,); 0 outside gaps.

        In a gap the motion may be any of the recording, one and the same all through it.
        """
        after = np.clip(np.searchsorted(self.seconds, t), 1, len(self.seconds) - 1)
        apart = self.seconds[after] - self.seconds[after - 1]
        return np.asarray((apart * (apart > _GAP))[:, None] * self._variance)

    @cached_property
    def _variance(self) -> FloatArray:
        """(6,) of rate and force over all of the recording."""
        return np.asarray(np.var(np.hstack([self.rate, self.force]), axis=0))

    def require_signals(self) -> None:
        """Raise InputError if an axis never changes: its sensor is dead, or the driver does not fill it in."""
        # Rounding gives a constant that is not zero a deviation of its last digits.
        if np.any(np.ptp(np.hstack([self.rate, self.force]), axis=0) == 0.0):
            raise InputError('an axis of the IMU says the same all the time')

    def averaged(self, seconds: float) -> 'ImuTrack':
        """Samples averaged over a window of ``seconds`` about each: the motion without vibration."""
        width = 2 * round(0.5 * seconds / float(np.median(np.diff(self.seconds)))) + 1
        rate, force = (np.asarray(cv2.blur(signal, (1, width)), np.float64) for signal in (self.rate, self.force))
        return ImuTrack(self.seconds, rate, force)

    @cached_property
    def force_slope(self) -> FloatArray:
        """(N, 3) derivative of the specific force [m/s^3]."""
        return np.asarray(np.gradient(self.force, self.seconds, axis=0))

    def corrected(self, axes: FloatArray, force_delay: float) -> 'ImuTrack':
        """Samples without the scale errors and misalignments ``axes`` (15,), see :func:`axis_errors`, at one time.

        ``force_delay``: of the force behind the rate [s].
        """
        prompt = self.force + force_delay * self.force_slope
        by_axes = axis_errors(self.rate, prompt) @ axes
        return ImuTrack(self.seconds, self.rate - by_axes[:, :3], prompt - by_axes[:, 3:])

    def noise(self, known: ImuNoise) -> SampleNoise:
        """``known`` with the white noise estimated from the samples, where vibration increases it."""
        root = float(np.median(np.diff(self.seconds))) ** 0.5
        rate, force = (
            root * float(np.sqrt(np.mean(np.diff(signal, 2, axis=0) ** 2) / _SECOND_DIFFERENCE))
            for signal in (self.rate, self.force)
        )
        return SampleNoise(
            max(rate, known.gyroscope_noise_density),
            max(force, known.accelerometer_noise_density),
            *bias_walks(known),
        )


def axis_errors(rate: FloatArray, force: FloatArray) -> FloatArray:
    """Derivative (N, 6, 15) of samples (N, 3), (N, 3) by the IMU's scale errors and misalignments.

    Those of the gyroscope are a full matrix (nine, row by row). The accelerometer's first axis and its plane with the
    second define the body frame, which leaves a lower triangle (six, row by row). J. Rehder et al., "Extending kalibr".
    """
    J = np.zeros((len(rate), 6, AXES))
    for row in range(3):
        J[:, row, 3 * row : 3 * row + 3] = rate
        first = GYROSCOPE_AXES + row * (row + 1) // 2
        J[:, 3 + row, first : first + row + 1] = force[:, : row + 1]
    return J


@dataclass(frozen=True)
class Increments:
    """Increments between consecutive frames; leading dimension (K,).

    Parameters
    ----------
    dt : [s]
    R, v, p : rotation (3, 3), velocity and position increments in the body frame at the interval's start
    by_bias : (9, 6) derivative of (rotation, velocity, position) by gyroscope and accelerometer bias
    by_axes : (9, 15) by scale errors and misalignments
    by_delay : (9,) by the delay of the accelerometer behind the gyroscope
    covariance : (9, 9) of the same
    """

    dt: FloatArray
    R: FloatArray
    v: FloatArray
    p: FloatArray
    by_bias: FloatArray
    by_axes: FloatArray
    by_delay: FloatArray
    covariance: FloatArray


def preintegrate(imu: ImuTrack, times: FloatArray, bias: FloatArray, noise: Densities) -> Increments:
    """Increments between ``times`` (K + 1,) [s, IMU's clock].

    Parameters
    ----------
    bias : (K, 6) gyroscope and accelerometer bias of each interval, about which the derivatives are taken
    """
    dt = np.diff(times)
    count = len(dt)
    # Of each interval its own: the long one while no marker is in view leaves the others as they are.
    steps = np.maximum(1, np.ceil(dt / _STEP).astype(np.int64))
    R, v, p = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    by_bias, by_axes = np.zeros((count, 9, 6)), np.zeros((count, 9, AXES))
    by_delay, covariance = np.zeros((count, 9, 1)), np.zeros((count, 9, 9))
    density = np.array([noise.gyroscope_noise_density] * 3 + [noise.accelerometer_noise_density] * 3) ** 2
    for step in range(int(steps.max())):
        on = np.flatnonzero(steps > step)
        h = (dt[on] / steps[on])[:, None]
        t = times[on] + (step + 0.5) * h[:, 0]
        rate, force = imu.at(t)
        axes = axis_errors(rate, force)
        rate, force = rate - bias[on, :3], force - bias[on, 3:]
        half = se3.so3_exp(0.5 * rate * h)
        middle = R[on] @ half
        transition, inputs = _linearised(middle, force, half, h[:, :, None])
        # Bias enters like noise, with the opposite sign, as it is subtracted from the sample.
        by_bias[on] = transition @ by_bias[on] - inputs
        by_axes[on] = transition @ by_axes[on] - inputs @ axes
        by_delay[on] = transition @ by_delay[on] + inputs[:, :, 3:] @ imu.slope_at(t)[:, :, None]
        covariance[on] = transition @ covariance[on] @ np.swapaxes(transition, 1, 2)
        covariance[on] += inputs @ (((density + imu.hidden(t)) / h)[:, :, None] * np.swapaxes(inputs, 1, 2))
        a = (middle @ force[:, :, None])[:, :, 0]
        p[on] += v[on] * h + 0.5 * a * h**2
        v[on] += a * h
        R[on] = middle @ half
    return Increments(dt, R, v, p, by_bias, by_axes, by_delay[:, :, 0], covariance)


def _linearised(
    middle: FloatArray, force: FloatArray, half: FloatArray, h: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Transition (K, 9, 9) of the errors (rotation, velocity, position), and input matrix (K, 9, 6) of the samples.

    Both are linearised at the ``middle`` of the step, after ``half`` of its rotation.
    """
    count = len(middle)
    back = np.swapaxes(half, 1, 2)
    by_turn = -middle @ se3.skew(force)
    transition = np.tile(np.eye(9), (count, 1, 1))
    transition[:, :3, :3] = back @ back
    transition[:, 3:6, :3] = by_turn @ back * h
    transition[:, 6:, :3] = 0.5 * by_turn @ back * h**2
    transition[:, 6:, 3:6] = np.eye(3) * h
    inputs = np.zeros((count, 9, 6))
    inputs[:, :3, :3] = back * h
    inputs[:, 3:6, :3] = 0.5 * by_turn * h**2
    inputs[:, 6:, :3] = 0.25 * by_turn * h**3
    inputs[:, 3:6, 3:] = middle * h
    inputs[:, 6:, 3:] = 0.5 * middle * h**2
    return transition, inputs
