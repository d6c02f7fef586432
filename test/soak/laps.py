"""A short flight from rest to rest, flown again and again: what passes for a bag of hours.

The pictures are those of the one flight that was rendered; the IMU's readings are drawn for the whole time, with biases
that walk on, so that a lap's end is nothing special to the filter.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
import heapq
from pathlib import Path
import struct

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu

from thermal_fiducial.files.bags import BagMessage, BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.images import header_stamp_ns
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.spline_trajectory import Motion, MotionPath
from thermal_fiducial.sim.thermal_camera import FlightPlan, plan, START_NS
from thermal_fiducial.sim.writer import IMU_DELAY_NS, write_flight

#: Of a lap [s]: whole periods of the frames, of the IMU and of the shutter, twice what take-off and landing take.
LAP = 24.0
TOPICS = (IMAGE_TOPIC, CAMERA_INFO_TOPIC, IMU_TOPIC)
#: A quarter of the pixels, as many degrees: markers of half the size, a quarter of the work.
SMALL_LENS = Lens((382.6, 382.3), (161.2, 125.4), 'plumb_bob', (-0.29, 0.11, 4e-4, -3e-4, 0.0), 320, 256)


def lap(*, small: bool = False) -> FlightPlan:
    """The flight of one lap before the wall of eight markers; ``small``: in pictures of 320x256."""
    wall = named('wall')
    return plan(replace(wall, lens=SMALL_LENS) if small else wall, LAP)


@dataclass(frozen=True)
class Repeated:
    """A trajectory that ends at rest where it began, again and again."""

    once: MotionPath
    period: float

    def __call__(self, t: np.ndarray) -> Motion:
        """The motion at times ``t`` (N,) [s]."""
        return self.once(np.mod(t, self.period))


class Laps:
    """As many laps as ``seconds`` take; a context manager.

    Parameters
    ----------
    folder : for the bag of one lap, which is made here
    flight : of one lap
    seconds : of all
    workers : processes that render
    """

    def __init__(self, folder: Path, flight: FlightPlan, seconds: float, workers: int = 2) -> None:
        self.folder, self.start_ns, self.scenario = folder / 'lap', START_NS, flight.scenario
        write_flight(self.folder, flight, workers=workers)
        self._bag = BagReader(self.folder)
        self._period_ns = round(flight.seconds * 1e9)
        self._ends_ns = START_NS + round(seconds * 1e9)
        path = Repeated(flight.scenario.trajectory(flight.seconds, flight.seed), flight.seconds)
        self._step_ns = round(1e9 / flight.scenario.imu.rate)
        ticks = np.arange(round(seconds * 1e9) // self._step_ns)
        times = ticks * self._step_ns * 1e-9
        record = flight.scenario.imu.sample(path, times, START_NS + ticks * self._step_ns, flight.seed)
        self._readings = np.hstack((record.angular_velocity, record.linear_acceleration))
        self._truth = path(times[: self._period_ns // self._step_ns]).T_map_body

    def __enter__(self) -> 'Laps':
        self._bag.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bag.__exit__(*exception)

    @property
    def imu_count(self) -> int:
        """Number of the IMU's samples."""
        return len(self._readings)

    def truth(self, stamp_ns: int) -> np.ndarray:
        """T_map_body (4, 4) at the stamp of an IMU sample."""
        return self._truth[(stamp_ns - START_NS) // self._step_ns % len(self._truth)]

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """Messages on ``topics`` in the order of arrival."""
        chosen = set(topics or TOPICS)
        streams = [self._camera(sorted(chosen - {IMU_TOPIC}))] + [self._imu()] * (IMU_TOPIC in chosen)
        return heapq.merge(*streams, key=lambda message: message.stamp_ns)

    def _camera(self, topics: list[str]) -> Iterator[BagMessage]:
        shift = 0
        while True:
            for message in self._bag.messages(topics):
                stamp_ns = message.stamp_ns + shift
                if stamp_ns >= self._ends_ns:
                    return
                yield replace(message, stamp_ns=stamp_ns, cdr=_later(message.cdr, shift))
            shift += self._period_ns

    def _imu(self) -> Iterator[BagMessage]:
        for tick, reading in enumerate(self._readings):
            stamp_ns = START_NS + tick * self._step_ns
            message = Imu(header=convert.header(stamp_ns, 'base_link'))
            message.angular_velocity = convert.vector(reading[:3])
            message.linear_acceleration = convert.vector(reading[3:])
            message.orientation_covariance[0] = -1.0
            data = serialize_message(message)
            yield BagMessage(IMU_TOPIC, 'sensor_msgs/msg/Imu', stamp_ns + IMU_DELAY_NS, data, None)


def _later(cdr: bytes, shift_ns: int) -> bytes:
    """A message in little-endian CDR that begins with a header, its stamp moved."""
    stamp = struct.pack('<iI', *divmod(header_stamp_ns(cdr) + shift_ns, 1_000_000_000))
    return cdr[:4] + stamp + cdr[12:]
