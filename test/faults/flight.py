"""A flight as what arrives: IMU samples and the corners of each frame in the order of arrival, and the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.scene import Marker
from thermal_fiducial.sim.spline_trajectory import Flight
from thermal_fiducial.sim.thermal_camera import plan, START_NS, true_corners

#: The nodes see a flight in full swing, from ``FIRST`` to ``LAST``; the fault begins once the filter knows its IMU, and
#: ends early enough for recovery to show [s].
FIRST, BEGIN, END, LAST = 4.0, 8.0, 10.0, 15.0
#: Left of the flight after that [s].
_LANDING = 5.0
#: About 1 m/s.
PATH = Flight(amplitude=(0.6, 0.7, 0.3), period=(5.0, 4.0, 3.5), sway_period=4.0, ground_time=0.0, climb_time=1.5)
#: From a frame's read-out until its markers arrive [s]: read-out, transport and detection.
LATE = 0.03
#: White error of a coordinate of a corner, as detected at a contrast of 8 K and with motion [px].
SIGMA_PX = 0.05
#: Of the camera: what a lens does is no fault, and without distortion corners cost a tenth.
LENS = Lens((765.2, 764.6), (322.9, 251.3))
#: On the wall; five of them are in view at a time.
MARKERS = 6


@dataclass(frozen=True)
class Event:
    """Something that arrives: at ``time`` [s] of the flight, of the instant ``sampled`` [s].

    ``value``: an IMU reading (6,), the rows of the markers of a frame, or its counts (H, W).
    """

    time: float
    sampled: float
    stamp_ns: int
    value: np.ndarray

    @property
    def is_imu(self) -> bool:
        """Whether it is an IMU sample."""
        return self.value.shape == (6,) and not self.value.dtype.names


def event(sampled: float, value: np.ndarray, late: float = 0.0) -> Event:
    """One of an exact clock."""
    return Event(sampled + late, sampled, START_NS + round(sampled * 1e9), value)


@dataclass(frozen=True)
class World:
    """Where things are at an instant: markers, the camera in the body, and markers whose IDs are there already."""

    markers: Sequence[Marker]
    T_body_camera: np.ndarray
    twins: Sequence[Marker] = ()


class Recorded:
    """The flight of a seed in front of a wall of markers, without any fault."""

    def __init__(self, seed: int, lens: Lens = LENS, last: float = LAST) -> None:
        self.seed = seed
        wall = named('wall')
        self.scenario = replace(
            wall,
            lens=lens,
            markers=wall.markers[:MARKERS],
            flight=PATH,
            # The shutter closes where that is the fault.
            sensor=replace(wall.sensor, ffc_period=0.0),
        )
        self.plan = plan(self.scenario, last + _LANDING, seed)
        self._path = self.scenario.trajectory(self.plan.seconds, seed)
        self._imu_times, _ = self.plan.imu_stamps()
        #: numbers of the frames that are seen
        self.indices = [k for k in range(self.plan.frame_count) if FIRST <= self.plan.frame_time(k) < last]
        self._last = last
        times = np.concatenate((self._imu_times, [self.plan.frame_time(index) for index in self.indices]))
        self._truth = dict(zip(times.tolist(), self._path(times).T_map_body, strict=True))
        self._lens = lens
        self.camera = Camera(lens.width, lens.height, lens.matrix, lens.model, np.array(lens.distortion))
        self.world = World(self.scenario.markers, self.scenario.T_body_camera)

    def truth(self, seconds: float) -> np.ndarray:
        """T_map_body (4, 4) at the instant of an IMU sample or a frame."""
        return self._truth[seconds]

    @property
    def marker_map(self) -> MarkerMap:
        """The true map."""
        return MarkerMap({m.id: MapMarker(m.id, m.size, True, m.T_map_marker) for m in self.scenario.markers})

    @cached_property
    def imu(self) -> list[Event]:
        """The IMU's samples."""
        times, stamps = self.plan.imu_stamps()
        record = self.scenario.imu.sample(self._path, times, stamps, self.seed)
        readings = np.hstack((record.angular_velocity, record.linear_acceleration))
        samples = [event(float(t), reading) for t, reading in zip(times, readings, strict=True)]
        return [item for item in samples if FIRST <= item.sampled < self._last]

    @cached_property
    def frames(self) -> list[Event]:
        """The markers of each frame."""
        return self.frames_of(lambda _: self.world)

    def frames_of(self, world_at: Callable[[float], World]) -> list[Event]:
        """The markers of each frame in a world that changes."""
        times = {index: self.plan.frame_time(index) for index in self.indices}
        return [event(t, self._rows(index, t, world_at(t)), LATE) for index, t in times.items()]

    def _rows(self, index: int, t: float, world: World) -> np.ndarray:
        T_map_camera = self.truth(t) @ world.T_body_camera
        seen = list(true_corners(self._lens, world.markers, [], T_map_camera).items())
        seen += true_corners(self._lens, world.twins, [], T_map_camera).items() if world.twins else ()
        ids = np.array([marker_id for marker_id, _ in seen], dtype=np.uint32)
        corners = np.array([uv for _, uv in seen]).reshape(-1, 4, 2)
        corners = corners + np.random.default_rng([self.seed, 11, index]).normal(0.0, SIGMA_PX, corners.shape)
        covariances = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(ids), 4, 2, 2))
        return rows_from_corners(ids, corners, covariances, np.full(len(ids), 0.3), self.camera)


@lru_cache(1)
def recorded(seed: int, lens: Lens = LENS) -> Recorded:
    """The flight of a seed, made once."""
    return Recorded(seed, lens)


@dataclass(frozen=True)
class Stream:
    """What arrives in a flight with a fault, in order, and what is done to the nodes.

    ``kills``: name of a node to when it dies and is back [s].
    """

    events: list[Event]
    kills: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, *parts: list[Event], kills: Mapping[str, tuple[float, float]] | None = None) -> 'Stream':
        """Events of all parts by time of arrival; of those at once, the IMU's first."""
        events = [item for part in parts for item in part]
        return cls(sorted(events, key=lambda item: (item.time, not item.is_imu)), kills or {})


def during(events: list[Event], change: Callable[[Event], Event | None], begin=BEGIN, end=END) -> list[Event]:
    """``events`` with those sampled between ``begin`` and ``end`` changed; None leaves them out."""
    changed = [change(item) if begin <= item.sampled < end else item for item in events]
    return [item for item in changed if item is not None]


def stamped(item: Event, seconds: float) -> Event:
    """The same with a stamp so much later."""
    return replace(item, stamp_ns=item.stamp_ns + round(seconds * 1e9))
