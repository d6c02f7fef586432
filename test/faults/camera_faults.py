"""What the camera, its clock, the detector's link and the markers may do."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from faults.flight import BEGIN, during, END, Event, Recorded, stamped, Stream, World
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.sim.scene import Marker

_FRAME = 1.0 / 30.0


def with_frames(change: Callable[[Event], Event | None], end: float = END) -> Callable[[Recorded], Stream]:
    """A fault that changes each frame until ``end``, or leaves it out."""
    return lambda flight: Stream.of(flight.imu, during(flight.frames, change, end=end))


def clock_step(seconds: float) -> Callable[[Recorded], Stream]:
    """The camera's clock is set."""
    return with_frames(lambda item: stamped(item, seconds), np.inf)


def clock_drift(rate: float) -> Callable[[Recorded], Stream]:
    """The camera's clock goes faster from the fault on, by a share of time."""
    return with_frames(lambda item: stamped(item, rate * (item.sampled - BEGIN)), np.inf)


def frozen(flight: Recorded) -> Stream:
    """The last frame's markers again and again, under new stamps."""
    last = next(item for item in reversed(flight.frames) if item.sampled < BEGIN)
    return with_frames(lambda item: replace(item, value=last.value))(flight)


def reordered(flight: Recorded) -> Stream:
    """Every second frame behind the next."""
    return with_frames(lambda item: replace(item, time=item.time + 1.5 * _FRAME * (_number(item) % 2)))(flight)


def doubled(flight: Recorded) -> Stream:
    """Each frame twice."""
    return Stream.of(flight.imu, flight.frames, [item for item in flight.frames if BEGIN <= item.sampled < END])


def late(seconds: float) -> Callable[[Recorded], Stream]:
    """Frames arrive later."""
    return with_frames(lambda item: replace(item, time=item.time + seconds))


# --- the world ----------------------------------------------------------------------------------------


def world(change: Callable[[World, float], World], end: float = np.inf) -> Callable[[Recorded], Stream]:
    """A fault by which things are elsewhere, ``change(world, seconds since the fault)``."""

    def stream(flight: Recorded) -> Stream:
        def at(t: float) -> World:
            return change(flight.world, t - BEGIN) if BEGIN <= t < end else flight.world

        return Stream.of(flight.imu, flight.frames_of(at))

    return stream


def moved(count: int, distance: float) -> Callable[[World, float], World]:
    """The first ``count`` markers hang so far [m] aside."""
    return lambda now, _: replace(now, markers=[_aside(m, distance * (i < count)) for i, m in enumerate(now.markers)])


def cart(speed: float) -> Callable[[World, float], World]:
    """One marker drives off along the wall [m/s]."""
    return lambda now, t: replace(now, markers=[_aside(m, speed * t * (i == 0)) for i, m in enumerate(now.markers)])


def twin(now: World, _: float) -> World:
    """A second marker of the first one's ID hangs 0.8 m below it."""
    x, y, z = now.markers[0].position
    return replace(now, twins=[replace(now.markers[0], position=(x, y, z - 0.5))])


def twin_alone(now: World, _: float) -> World:
    """Nothing is in view but a second marker of the first one's ID, in the place of the fourth."""
    return replace(now, markers=[replace(now.markers[3], id=now.markers[0].id)])


def foreign(now: World, _: float) -> World:
    """Two markers that the map does not know."""
    unmapped = [
        replace(m, id=m.id + 30, position=(m.position[0], m.position[1], m.position[2] - 0.4)) for m in now.markers[:2]
    ]
    return replace(now, markers=[*now.markers, *unmapped])


def replaced(now: World, _: float) -> World:
    """The IDs of two markers are exchanged."""
    first, second, *rest = now.markers
    return replace(now, markers=[replace(first, id=second.id), replace(second, id=first.id), *rest])


def alone(change: Callable[[World, float], World], end: float = np.inf) -> Callable[[Recorded], Stream]:
    """The same where one marker is all there is."""

    def stream(flight: Recorded) -> Stream:
        lone = replace(flight.world, markers=flight.world.markers[:1])
        return Stream.of(flight.imu, flight.frames_of(lambda t: change(lone, t - BEGIN) if BEGIN <= t < end else lone))

    return stream


def lone_map(flight: Recorded) -> MarkerMap:
    """The map of the first marker alone."""
    first = flight.world.markers[0].id
    return MarkerMap({first: flight.marker_map.markers[first]})


def knocked(degrees: float) -> Callable[[World, float], World]:
    """The camera is turned on its mount, about its vertical axis and half as much about the other."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(
        'yx', np.array([1.0, 0.5]) * degrees / np.hypot(1.0, 0.5), degrees=True
    ).as_matrix()
    return lambda now, _: replace(now, T_body_camera=now.T_body_camera @ turn)


def _aside(marker: Marker, distance: float) -> Marker:
    x, y, z = marker.position
    return replace(marker, position=(x, y + distance, z)) if distance else marker


def _number(item: Event) -> int:
    return round(item.sampled / _FRAME)
