"""Every fault by name."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from faults import camera_faults, imu_faults, picture_faults
from faults.flight import BEGIN, END, Recorded, Stream

#: A node that was killed is back after this [s]: start-up as it is measured, and a supervisor's reaction.
BACK = 3.0


@dataclass(frozen=True)
class Fault:
    """A fault.

    Parameters
    ----------
    group, name : in the table
    stream : what arrives of a flight with it
    ends : when it is over [s of the flight]; a fault for good is over as soon as it is there
    lone : one marker is all there is
    mode : of the mapper
    pictures : whether frames are rendered, instead of markers being made up
    """

    group: str
    name: str
    stream: Callable[[Recorded], Stream]
    ends: float = END
    lone: bool = False
    mode: str = 'localization'
    pictures: bool = False


def _killed(name: str) -> Callable[[Recorded], Stream]:
    return lambda flight: Stream.of(flight.imu, flight.frames, kills={name: (BEGIN, BEGIN + BACK)})


def _imu() -> list[Fault]:
    two_seconds = {
        'frozen: the last sample again and again': imu_faults.frozen,
        'all zero': imu_faults.reading(np.zeros_like),
        'saturated: vertical force and yaw rate at full scale': imu_faults.reading(imu_faults.saturated),
        'saturated: forward force at full scale': imu_faults.one_axis(3, 156.9),
        'gyroscope dead: zero': imu_faults.scaled(0.0, 1.0),
        'accelerometer dead: zero': imu_faults.scaled(1.0, 0.0),
        'one axis of the gyroscope dead (yaw)': imu_faults.one_axis(2, 0.0),
        'one axis of the gyroscope dead (pitch)': imu_faults.one_axis(1, 0.0),
        'one axis of the accelerometer dead (forward)': imu_faults.one_axis(3, 0.0),
        'one axis of the accelerometer dead (up)': imu_faults.one_axis(5, 0.0),
        'single samples at full scale': imu_faults.now_and_then(imu_faults.at_full_scale),
        'single samples of zeros': imu_faults.now_and_then(np.zeros_like),
        'forces in g': imu_faults.scaled(1.0, 1.0 / 9.80665),
        'forces times 9.81': imu_faults.scaled(1.0, 9.80665),
        'rates in degrees': imu_faults.scaled(180.0 / np.pi, 1.0),
        'axes x and y swapped': imu_faults.reading(imu_faults.swapped),
        'bias step of 1 m/s^2': imu_faults.reading(imu_faults.biased),
        'rates doubled': imu_faults.scaled(2.0, 1.0),
        'stopped for 2 s': imu_faults.stopped,
        'every second sample late': imu_faults.reordered,
        'each sample twice': imu_faults.doubled,
        'each sample twice, with stamps of its own': imu_faults.doubled_with_stamps,
    }
    for_good = {
        'one stamp 0.5 s ahead': imu_faults.one_stamp_ahead,
        'clock steps by 10 ms': imu_faults.clock_step(0.01),
        'clock steps by -50 ms': imu_faults.clock_step(-0.05),
        'clock steps by -0.2 s': imu_faults.clock_step(-0.2),
        'clock steps by 0.5 s': imu_faults.clock_step(0.5),
        'all clocks step by an hour': imu_faults.all_stamps_ahead,
    }
    return _faults('IMU', two_seconds, END) + _faults('IMU', for_good, BEGIN)


def _camera() -> list[Fault]:
    frames = {
        'no frames for 2 s': camera_faults.with_frames(lambda item: None),
        'markers frozen for 2 s, stamps go on': camera_faults.frozen,
        'frames in wrong order': camera_faults.reordered,
        'each frame twice': camera_faults.doubled,
        'frames 0.3 s late': camera_faults.late(0.3),
        'frames 2 s late': camera_faults.late(2.0),
    }
    steps = (0.01, -0.01, 0.05, -0.05, 0.2, -0.2, 0.5, -0.5, 1.0, -1.0)
    clock = {f'clock steps by {1e3 * step:.0f} ms': camera_faults.clock_step(step) for step in steps}
    clock |= {f'clock drifts by {rate:g} ms/s': camera_faults.clock_drift(1e-3 * rate) for rate in (0.1, 1.0, 5.0)}
    clock |= {'knocked by 2 deg': camera_faults.world(camera_faults.knocked(2.0))}
    return _faults('camera', frames, END) + _faults('camera', clock, BEGIN)


def _markers() -> list[Fault]:
    world = {
        'one of six moved by 0.5 m': camera_faults.world(camera_faults.moved(1, 0.5)),
        'one of six moved by 5 cm': camera_faults.world(camera_faults.moved(1, 0.05)),
        'two of six moved by 0.3 m': camera_faults.world(camera_faults.moved(2, 0.3)),
        'a second one of the same ID': camera_faults.world(camera_faults.twin),
        'a second one of the same ID, alone in view': camera_faults.world(camera_faults.twin_alone),
        'two exchange their IDs': camera_faults.world(camera_faults.replaced),
        'two foreign ones': camera_faults.world(camera_faults.foreign),
        'one on a cart at 0.3 m/s': camera_faults.world(camera_faults.cart(0.3)),
    }
    localization = _faults('markers', world, BEGIN)
    mapping = [replace(fault, name=f'{fault.name}, mapping', mode='mapping') for fault in localization]
    lone = {
        'a lone one moved by 0.5 m': camera_faults.alone(camera_faults.moved(1, 0.5)),
        'a lone one moved by 5 cm': camera_faults.alone(camera_faults.moved(1, 0.05)),
        'a lone one on a cart at 0.3 m/s': camera_faults.alone(camera_faults.cart(0.3)),
    }
    return localization + mapping + [replace(fault, lone=True) for fault in _faults('markers', lone, BEGIN)]


def _nodes() -> list[Fault]:
    streams = {name: _killed(name) for name in ('marker_mapper', 'pose_ekf')}
    return [_kill(name, stream) for name, stream in streams.items()]


def _pictures() -> list[Fault]:
    two_seconds = {
        'a picture that stands still': picture_faults.frozen,
        'upper counts at full scale': picture_faults.saturated,
        'all counts at full scale': picture_faults.full_scale,
    }
    shutter = {
        'shutter for 0.5 s, last picture repeated': picture_faults.shutter_frozen,
        'shutter for 0.5 s, its pictures sent': picture_faults.shutter_flat,
    }
    back = BEGIN + BACK
    kills = [_kill(name, picture_faults.killed(name, back)) for name in ('tau2_camera', 'aruco_detector')]
    faults = (
        _faults('pictures', {'no fault': picture_faults.with_pictures(lambda item: item)}, BEGIN)
        + _faults('pictures', two_seconds, END)
        + _faults('pictures', shutter, picture_faults.SHUTTER_ENDS)
        + _faults('pictures', {'fog up to 0 K in 1 s, for 1 s, clears in 1 s': picture_faults.fog}, END + 1.0)
    )
    return [replace(fault, pictures=True) for fault in faults + kills]


def _kill(name: str, stream: Callable[[Recorded], Stream]) -> Fault:
    return Fault('nodes', f'`{name}` killed, back after {BACK:.0f} s', stream, BEGIN + BACK)


def _faults(group: str, streams: dict[str, Callable[[Recorded], Stream]], ends: float) -> list[Fault]:
    return [Fault(group, name, stream, ends) for name, stream in streams.items()]


NO_FAULT = Fault('none', 'no fault', lambda flight: Stream.of(flight.imu, flight.frames), BEGIN)
FAULTS = [NO_FAULT, *_imu(), *_camera(), *_markers(), *_nodes(), *_pictures()]
