"""A simulated flight as a rosbag2, with all files that its replay needs."""

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
import heapq
from itertools import takewhile
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import signal
import threading
from typing import Any

import cv2
import numpy as np

from thermal_fiducial.core.types import IntArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC, TRUTH_TOPIC
from thermal_fiducial.files.map_format import dump_document, MapDocument, MarkerEntry
from thermal_fiducial.files.plain_yaml import save_plain
from thermal_fiducial.files.rosbags_types import MAP_FRAME
from thermal_fiducial.files.trajectory_file import save_tum
from thermal_fiducial.files.work_folders import made_whole
from thermal_fiducial.files.writing import write_text
from thermal_fiducial.sim import messages
from thermal_fiducial.sim.imu import ImuRecord
from thermal_fiducial.sim.scenario import Scenario
from thermal_fiducial.sim.scene import Marker
from thermal_fiducial.sim.thermal_camera import CHUNK, FlightPlan, plan, SimFrame, START_NS, ThermalCamera

#: Delay of a frame from its read-out to the recorder [ns]; IMU samples and ground truth have less.
IMAGE_DELAY_NS = 25_000_000
IMU_DELAY_NS = 1_000_000


@dataclass(frozen=True)
class _Event:
    """A message for the bag."""

    arrival_ns: int
    topic: str
    message: Any


def simulate(out: str | Path, scenario: Scenario | str = 'fog', seconds: float | None = None, seed: int = 0) -> Path:
    """Simulate a flight into the new folder ``out``.

    Parameters
    ----------
    out : becomes a rosbag2 with the truth, the true map and the parameters in it, see :func:`write_flight`
    scenario : name (``thermal-fiducial simulate --help`` lists them) or object
    seconds : length of the flight, at least 11; None: the scenario's own
    seed : of path and noise; the same seed gives the same bytes

    Returns
    -------
    The folder.

    Raises
    ------
    InputError
        ``out`` exists or cannot be written, there is no such scenario, or ``seconds`` or ``seed`` are unusable.
    """
    folder = Path(out)
    write_flight(folder, plan(scenario, seconds, seed))
    return folder


def write_flight(
    out: Path,
    flight: FlightPlan,
    storage: str = 'mcap',
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Simulate ``flight`` into the new folder ``out``, which exists only once it is complete.

    Parameters
    ----------
    out : a rosbag2 with ``ground_truth.tum``, ``ground_truth_corners.csv``, ``map_true.yaml``, ``map_one.yaml`` (one
        fixed marker, the start of a map) and ``params.yaml`` (the rig) in it
    storage : mcap or sqlite3
    workers : number of rendering processes; the bytes do not depend on it
    progress : called with the number of frames written since the last call

    Raises
    ------
    InputError
        ``out`` exists or cannot be written, or the scenario is impossible.
    """
    try:
        with made_whole(out) as folder:
            _write_bag(folder, flight, storage, workers, progress or (lambda _: None))
            write_side_files(folder, flight)
    except RendererDiedError:
        raise InputError(f'{out}: a rendering process died, perhaps for lack of memory') from None


def _write_bag(folder: Path, flight: FlightPlan, storage: str, workers: int, progress: Callable[[int], None]) -> None:
    corners = ['stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3\n']
    # Closed after an error too, and not by the garbage collector, which may do so in any thread.
    with closing(_frames(flight, workers)) as rendered, BagWriter(folder, storage) as bag:
        frames = _noting_corners(rendered, corners)
        events = heapq.merge(_body_events(flight), _camera_events(frames, flight), key=lambda event: event.arrival_ns)
        for event in events:
            bag.write(event.topic, event.arrival_ns, event.message)
            if event.topic == IMAGE_TOPIC:
                progress(1)
    write_text(folder / 'ground_truth_corners.csv', ''.join(corners))


def _noting_corners(frames: Iterable[SimFrame], lines: list[str]) -> Iterator[SimFrame]:
    for frame in frames:
        for marker_id, corners in frame.corners_px.items():
            numbers = ','.join(f'{value:.4f}' for value in corners.ravel())
            lines.append(f'{frame.stamp_ns},{marker_id},{numbers}\n')
        yield frame


def _camera_events(frames: Iterable[SimFrame], flight: FlightPlan) -> Iterator[_Event]:
    for frame in frames:
        arrival = START_NS + round(frame.seconds * SECOND_NS) + IMAGE_DELAY_NS
        yield _Event(arrival, CAMERA_INFO_TOPIC, messages.camera_info(flight.scenario.lens, frame.stamp_ns))
        yield _Event(arrival, IMAGE_TOPIC, messages.image(frame, eight_bit=flight.scenario.sensor.full_scale < 256))


def _body_events(flight: FlightPlan) -> Iterator[_Event]:
    """IMU samples, and the ground truth at their stamps."""
    scenario = flight.scenario
    times, stamps = flight.imu_stamps()
    trajectory = scenario.trajectory(flight.seconds, flight.seed)
    record, motion = scenario.imu.sample(trajectory, times, stamps, flight.seed), trajectory(times)
    quaternions, velocities = motion.rotation.as_quat(), motion.rotation.inv().apply(motion.velocity)
    truth = zip(motion.position, quaternions, velocities, motion.angular_velocity_body, strict=True)
    samples = zip(record.stamps_ns.tolist(), record.angular_velocity, record.linear_acceleration, strict=True)
    yield from heapq.merge(
        (
            _Event(arrival + IMU_DELAY_NS, IMU_TOPIC, messages.imu(*sample, scenario.imu))
            for arrival, sample in zip(_arrivals(record, stamps, scenario), samples, strict=True)
        ),
        (
            _Event(stamp + IMU_DELAY_NS, TRUTH_TOPIC, messages.odometry(stamp, *state))
            for stamp, state in zip(flight.truth_stamps().tolist(), truth, strict=True)
        ),
        key=lambda event: event.arrival_ns,
    )


def _arrivals(record: ImuRecord, stamps: IntArray, scenario: Scenario) -> list[int]:
    """Times [ns] at which samples are read, in order: those of the ``stamps``, or at which a driver stamps them."""
    if scenario.imu.delivery is None:
        return stamps.tolist()  # type: ignore[no-any-return]
    return np.maximum.accumulate(record.stamps_ns).tolist()  # type: ignore[no-any-return]


# --- rendering in chunks ------------------------------------------------------------------------------


class RendererDiedError(Exception):
    """A rendering process ended before it had sent its frames."""


def _frames(flight: FlightPlan, workers: int) -> Generator[SimFrame, None, None]:
    if workers <= 1:
        yield from ThermalCamera(flight).frames(0, flight.frame_count)
        return
    starts = list(range(0, flight.frame_count, CHUNK))
    with _rendering(flight, starts, min(workers, len(starts))) as pipes:
        for index in range(len(starts)):
            try:
                chunk = pipes[index % len(pipes)].recv()
            except (EOFError, OSError):
                raise RendererDiedError from None
            if isinstance(chunk, Exception):
                raise chunk
            yield from chunk


@contextmanager
def _rendering(flight: FlightPlan, starts: Sequence[int], count: int) -> Iterator[list[Connection]]:
    """Processes that send the chunks of frames that begin at ``starts``, in turns, each through a pipe of its own.

    The only other end of a pipe is in its process: when that ends in any way, even half-way through a chunk, so does
    the pipe. Of the pools of Python all workers share one pipe, which stays open, and whoever reads it waits for ever.
    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')  # a worker is to use one core
    context = multiprocessing.get_context('spawn')  # a fork of a process that runs ROS deadlocks
    pipes, workers = [], []
    try:
        # Its children inherit this: an interrupt may reach them before their first line.
        with _interrupts_ignored():
            for first in range(count):
                ours, theirs = context.Pipe(duplex=False)
                pipes.append(ours)
                with theirs:
                    arguments = (flight, starts[first::count], theirs, os.getpid())
                    workers.append(context.Process(target=_render, args=arguments, daemon=True))
                    workers[-1].start()
        yield pipes
    finally:
        for worker in workers:
            if worker.pid is not None:
                worker.kill()
                worker.join()
        for pipe in pipes:
            pipe.close()


def _render(flight: FlightPlan, starts: Sequence[int], pipe: Connection, parent: int) -> None:
    """Send the chunks that begin at ``starts``, or what went wrong; end with the ``parent``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process ends us
    cv2.setNumThreads(1)
    # Nobody waits for the frames when the parent has been killed.
    with suppress(BrokenPipeError):
        try:
            camera = ThermalCamera(flight)
            for start in starts:
                frames = camera.frames(start, min(start + CHUNK, flight.frame_count))
                pipe.send(list(takewhile(lambda _: os.getppid() == parent, frames)))
        except Exception as error:  # raised by the parent, whatever it is
            pipe.send(error)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# --- what a replay needs beside the bag ---------------------------------------------------------------


def write_side_files(folder: Path, flight: FlightPlan) -> None:
    """Write ground truth, maps and parameters of a flight into the folder of its bag."""
    scenario = flight.scenario
    times, _ = flight.imu_stamps()
    motion = scenario.trajectory(flight.seconds, flight.seed)(times)
    save_tum(folder / 'ground_truth.tum', flight.truth_stamps().tolist(), motion.position, motion.rotation.as_quat())
    write_text(folder / 'map_true.yaml', _marker_map(scenario, scenario.markers))
    write_text(folder / 'map_one.yaml', _marker_map(scenario, scenario.markers[:1]))
    save_plain(folder / 'params.yaml', {'/**': {'ros__parameters': _parameters(flight)}})


def _marker_map(scenario: Scenario, markers: tuple[Marker, ...]) -> str:
    entries = [
        MarkerEntry(
            marker.id, marker.size, True, tuple(map(float, marker.position)), tuple(marker.rotation.as_quat().tolist())
        )
        for marker in markers
    ]
    return dump_document(MapDocument(tuple(entries), MAP_FRAME, scenario.dictionary))


def _parameters(flight: FlightPlan) -> dict[str, Any]:
    """The rig as parameters of the nodes."""
    scenario = flight.scenario
    sizes = [marker.size for marker in scenario.markers]
    common = max(set(sizes), key=sizes.count)
    overrides = [f'{marker.id}:{marker.size}' for marker in scenario.markers if marker.size != common]
    noise = scenario.imu.noise
    return {
        'dictionary': scenario.dictionary,
        'marker_size': common,
        **({'marker_size_overrides': overrides} if overrides else {}),
        'camera_position': [float(value) for value in scenario.camera_position],
        'camera_orientation': [float(value) for value in scenario.camera_orientation],
        # Nothing is measured or calibrated here: all is exactly as the parameters say.
        'marker_size_std': 0.0,
        'focal_length_std': 0.0,
        'readout_time_std': 0.0,
        'extrinsics_position_std': 0.0,
        'extrinsics_orientation_std': 0.0,
        'camera_time_offset': float(scenario.camera_time_offset + flight.imu_delay_ns() / SECOND_NS),
        **({} if scenario.sensor.lag else {'bolometer_lag': 0.0}),
        **({'readout_time': scenario.sensor.readout} if scenario.sensor.readout else {}),
        'imu': {item.name: getattr(noise, item.name) for item in fields(noise)},
    }
