"""What an IMU, its cable or its driver may do."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from faults.flight import BEGIN, during, END, Event, Recorded, stamped, Stream

#: Full scales of the sensors [rad/s, m/s^2].
_FULL_SCALE = np.repeat([34.9, 156.9], 3)


def reading(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recorded], Stream]:
    """A fault that changes each reading (6,)."""
    return lambda flight: Stream.of(
        during(flight.imu, lambda item: replace(item, value=change(item.value.copy()))), flight.frames
    )


def frozen(flight: Recorded) -> Stream:
    """The last sample again and again, under new stamps."""
    last = next(item for item in reversed(flight.imu) if item.sampled < BEGIN)
    return Stream.of(during(flight.imu, lambda item: replace(item, value=last.value)), flight.frames)


def now_and_then(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recorded], Stream]:
    """A fault that changes single readings (6,), five in two seconds."""

    def corrupt(item: Event) -> Event:
        spoilt = round(item.sampled / 0.005) % 80 == 40
        return replace(item, value=change(item.value.copy())) if spoilt else item

    return lambda flight: Stream.of(during(flight.imu, corrupt), flight.frames)


def at_full_scale(imu: np.ndarray) -> np.ndarray:
    """What a failed transfer of ones and zeros reads: all six at the lower end of their range."""
    return -_FULL_SCALE + 0.0 * imu


def one_axis(axis: int, value: float) -> Callable[[Recorded], Stream]:
    """A fault by which one axis of six says ``value`` and nothing else."""

    def change(imu: np.ndarray) -> np.ndarray:
        imu[axis] = value
        return imu

    return reading(change)


def biased(imu: np.ndarray) -> np.ndarray:
    """A step of the accelerometer's bias by 1 m/s^2."""
    return imu + np.eye(6)[3]


def swapped(imu: np.ndarray) -> np.ndarray:
    """The axes x and y in each other's place."""
    return imu[[1, 0, 2, 4, 3, 5]]


def saturated(imu: np.ndarray) -> np.ndarray:
    """Vertical force and one rate at their full scale."""
    return np.where([False, False, True, False, False, True], _FULL_SCALE, imu)


def scaled(rate: float, force: float) -> Callable[[Recorded], Stream]:
    """Rates and forces times so much."""
    return reading(lambda imu: imu * np.repeat([rate, force], 3))


def stopped(flight: Recorded) -> Stream:
    """No sample."""
    return Stream.of(during(flight.imu, lambda item: None), flight.frames)


def reordered(flight: Recorded) -> Stream:
    """Every second sample behind the next."""
    return Stream.of(
        during(flight.imu, lambda item: replace(item, time=item.time + 0.0075 * _odd(item))), flight.frames
    )


def doubled(flight: Recorded) -> Stream:
    """Each sample twice."""
    again = [item for item in flight.imu if BEGIN <= item.sampled < END]
    return Stream.of(flight.imu, again, flight.frames)


def doubled_with_stamps(flight: Recorded) -> Stream:
    """Each sample twice, the second time with a stamp in the middle of two."""
    again = [stamped(item, 0.0025) for item in flight.imu if BEGIN <= item.sampled < END]
    again = [replace(item, time=item.time + 0.0025) for item in again]
    return Stream.of(flight.imu, again, flight.frames)


def one_stamp_ahead(flight: Recorded) -> Stream:
    """One stamp half a second ahead."""
    return Stream.of(during(flight.imu, lambda item: stamped(item, 0.5), end=BEGIN + 0.004), flight.frames)


def all_stamps_ahead(flight: Recorded) -> Stream:
    """All stamps, those of the camera too, an hour ahead."""
    hour_later = [during(part, lambda item: stamped(item, 3600.0), end=np.inf) for part in (flight.imu, flight.frames)]
    return Stream.of(*hour_later)


def clock_step(seconds: float) -> Callable[[Recorded], Stream]:
    """The IMU's clock is set."""
    return lambda flight: Stream.of(during(flight.imu, lambda item: stamped(item, seconds), end=np.inf), flight.frames)


def _odd(item: Event) -> bool:
    return bool(round(item.sampled * 200.0) % 2)
