"""The camera's frames over a flight: rendering, sensor, shutter, truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.types import BoolArray, Counts, FloatArray, IntArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.imu import ImuRecord
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.render import Quality, Renderer
from thermal_fiducial.sim.scenario import named, Scenario
from thermal_fiducial.sim.scene import Marker, Plate

#: Stamp of the start of every flight.
START_NS = 1_700_000_000_000_000_000
#: Number of frames in a chunk. Each chunk begins with a warm-up, so that the bytes do not depend on the workers.
CHUNK = 30

#: Longest simulated flight [s].
LONGEST_FLIGHT_S = 3_600.0

_DEFAULT_QUALITY = Quality()
# Distance from the image's border from which on a marker counts as wholly in it [px].
_MARGIN_PX = 1.0


@dataclass(frozen=True)
class SimFrame:
    """One frame with its ground truth.

    Parameters
    ----------
    stamp_ns : when its middle row was read out, in the camera's clock
    seconds : the same since the start, in the IMU's clock
    counts : (height, width) uint16
    shutter : whether the shutter is closed
    T_map_camera : (4, 4) at that time
    corners_px : ID to true corners (4, 2), for each marker that lies wholly in the image, faces the camera and is not
        hidden, also while the shutter is closed
    """

    stamp_ns: int
    seconds: float
    counts: Counts
    shutter: bool
    T_map_camera: FloatArray
    corners_px: dict[int, FloatArray]


@dataclass(frozen=True)
class FlightPlan:
    """A scenario with its length and seed.

    Parameters
    ----------
    noise : False: no noise, no fixed pattern, no bad pixels, no shutter
    quality : of the renderer
    """

    scenario: Scenario
    seconds: float
    seed: int
    noise: bool = True
    quality: Quality = _DEFAULT_QUALITY

    @property
    def sensor_scenario(self) -> Scenario:
        """The scenario; its sensor has no noise if ``noise`` is False."""
        return self.scenario if self.noise else replace(self.scenario, sensor=self.scenario.sensor.without_noise())

    @property
    def frame_count(self) -> int:
        """Number of exposures."""
        return int(self.seconds * self.scenario.sensor.frame_rate)

    def frame_time(self, index: int) -> float:
        """Read-out of frame ``index`` since the start, in the IMU's clock [s]."""
        return (index + 1) / self.scenario.sensor.frame_rate

    def stamp_ns(self, index: int) -> int:
        """Stamp of frame ``index`` in the camera's clock."""
        late = self.scenario.stamp_jitter * (np.random.default_rng([self.seed, 9, index]).exponential() - 1.0)
        return START_NS + round((self.frame_time(index) - self.scenario.camera_time_offset + late) * SECOND_NS)

    def imu_stamps(self) -> tuple[FloatArray, IntArray]:
        """Times [s] and true stamps [ns] of the IMU's samples."""
        rate = self.scenario.imu.rate
        ticks = np.arange(int(self.seconds * rate) + 1, dtype=np.int64)
        nanoseconds = np.round(ticks * (SECOND_NS / rate)).astype(np.int64)
        return np.asarray(nanoseconds * 1e-9), nanoseconds + START_NS

    def imu_delay_ns(self) -> int:
        """How much later than its samples are taken the IMU's stamps are in the mean: its clock is late by that."""
        if (delivery := self.scenario.imu.delivery) is None:
            return 0
        times, _ = self.imu_stamps()
        kept, stamps = delivery.stamps(times)
        return round(float(np.mean(stamps - times[kept] * SECOND_NS)))

    def truth_stamps(self) -> IntArray:
        """Stamps [ns] of the ground truth at the times of the samples, in the IMU's clock."""
        return self.imu_stamps()[1] + self.imu_delay_ns()


def plan(
    scenario: Scenario | str,
    seconds: float | None = None,
    seed: int = 0,
    *,
    noise: bool = True,
    quality: Quality = _DEFAULT_QUALITY,
) -> FlightPlan:
    """A flight of ``scenario`` (an object or a name), by default of the scenario's length.

    Raises
    ------
    InputError
        No such scenario, a length that is none, or a seed that is no whole number from 0 on.
    """
    chosen = named(scenario) if isinstance(scenario, str) else scenario
    seconds = chosen.seconds if seconds is None else seconds
    if not (isinstance(seconds, (int, float)) and 0.0 < seconds <= LONGEST_FLIGHT_S):
        raise InputError(f'a flight of {seconds!r} s: it is to be longer than 0 s, and {LONGEST_FLIGHT_S:g} s at most')
    if not (isinstance(seed, int) and seed >= 0):
        raise InputError(f'seed {seed!r}: it is to be a whole number from 0 on')
    return FlightPlan(chosen, seconds, seed, noise, quality)


def render_frames(
    scenario: Scenario | str,
    seconds: float | None = None,
    seed: int = 0,
    *,
    noise: bool = True,
    quality: Quality = _DEFAULT_QUALITY,
    start: int = 0,
    stop: int | None = None,
) -> Iterator[SimFrame]:
    """Frames ``start`` to ``stop`` of a flight, in order.

    With ``ffc_behaviour`` ``dropped`` the frames of the closed shutter are missing.
    """
    flight = plan(scenario, seconds, seed, noise=noise, quality=quality)
    camera = ThermalCamera(flight)
    yield from camera.frames(start, flight.frame_count if stop is None else min(stop, flight.frame_count))


def simulate_imu(scenario: Scenario | str, seconds: float | None = None, seed: int = 0) -> ImuRecord:
    """The IMU's samples of the same flight."""
    flight = plan(scenario, seconds, seed)
    times, stamps = flight.imu_stamps()
    trajectory = flight.scenario.trajectory(flight.seconds, seed)
    return flight.scenario.imu.sample(trajectory, times, stamps, seed)


def true_corners(
    lens: Lens, markers: Sequence[Marker], plates: Sequence[Plate], T_map_camera: FloatArray
) -> dict[int, FloatArray]:
    """ID to corners (4, 2) [px] of the markers that lie wholly in the image, face the camera and are not hidden."""
    R, origin = T_map_camera[:3, :3], T_map_camera[:3, 3]
    high = np.array([lens.width, lens.height]) - 1 - _MARGIN_PX
    poses = np.array([marker.T_map_marker for marker in markers]).reshape(-1, 4, 4)
    points = (np.array([marker.corners_map for marker in markers]).reshape(-1, 4, 3) - origin) @ R
    faces = np.sum((origin - poses[:, :3, 3]) * poses[:, :3, 2], axis=1) > 0
    ahead = np.flatnonzero(faces & np.all(points[..., 2] >= 0.05, axis=1))
    pixels = lens.project(points[ahead])
    inside = np.all((pixels >= _MARGIN_PX) & (pixels <= high), axis=(1, 2))
    ahead, pixels = ahead[inside], pixels[inside]
    whole = np.all(_unfolded(lens, points[ahead], pixels), axis=1)
    seen = [(markers[index], uv) for index, uv in zip(ahead[whole], pixels[whole], strict=True)]
    if not seen:
        return {}
    if not plates:
        return {marker.id: pixels for marker, pixels in seen}
    spread = np.array([marker.spread_map for marker, _ in seen])
    hidden = np.any([plate.hides(origin, spread) for plate in plates], axis=(0, 2))
    return {marker.id: pixels for (marker, pixels), covered in zip(seen, hidden, strict=True) if not covered}


def sees_markers(flight: FlightPlan) -> bool:
    """Whether any frame of a flight shows a marker."""
    scenario = flight.scenario
    times = [flight.frame_time(index) for index in range(flight.frame_count)]
    poses = scenario.trajectory(flight.seconds, flight.seed)(times).T_map_body @ scenario.T_body_camera
    return any(true_corners(scenario.lens, scenario.markers, [], T) for T in poses)


def _unfolded(lens: Lens, points: FloatArray, pixels: FloatArray) -> BoolArray:
    """Whether the lens maps the pixels back to the points: distortion folds points beyond its field into the image."""
    slopes = points[..., :2] / points[..., 2:]
    off = np.linalg.norm(lens.slopes(pixels) - slopes, axis=-1)
    return np.asarray(off < 1e-6 * (1.0 + np.linalg.norm(slopes, axis=-1)))


class ThermalCamera:
    """Frames of one flight."""

    def __init__(self, flight: FlightPlan) -> None:
        scenario = flight.sensor_scenario
        self._flight, self._scenario, self._sensor = flight, scenario, scenario.sensor
        self._plates = scenario.plates
        self._renderer = Renderer(
            scenario.lens,
            self._plates,
            scenario.room,
            scenario.fog,
            scenario.acrylic,
            scenario.trajectory(flight.seconds, flight.seed),
            scenario.T_body_camera,
            1.0 / scenario.sensor.frame_rate,
            scenario.sensor.lag,
            flight.quality,
            scenario.sensor.readout,
            scenario.sensor.psf_sigma_px,
        )
        self._last: tuple[int, Counts] | None = None

    def frames(self, start: int, stop: int) -> Iterator[SimFrame]:
        """Frames ``start`` to ``stop``, whole chunks at a time."""
        for index in range(start, stop):
            if index % CHUNK == 0:
                self._renderer.forget()
                self._last = None
            frame = self._frame(index)
            if frame is not None:
                yield frame

    def _frame(self, index: int) -> SimFrame | None:
        t = self._flight.frame_time(index)
        shutter = self._closed(index)
        if shutter and self._sensor.ffc_behaviour == 'dropped':
            return None
        counts = self._shutter_counts(index, t) if shutter else self._live_counts(index)
        T_map_camera = self._renderer.camera_poses(np.array([t]))[0]
        corners = true_corners(self._scenario.lens, self._scenario.markers, self._plates, T_map_camera)
        return SimFrame(self._flight.stamp_ns(index), t, counts, shutter, T_map_camera, corners)

    def _live_counts(self, index: int) -> Counts:
        t = self._flight.frame_time(index)
        counts = self._sensor.counts(self._renderer.frame(t), t, index, self._flight.seed)
        self._last = index, counts
        return counts

    def _shutter_counts(self, index: int, t: float) -> Counts:
        if self._sensor.ffc_behaviour == 'frozen':
            return self._frozen_counts(index)
        flat = np.full((self._scenario.lens.height, self._scenario.lens.width), self._sensor.shutter_excess, np.float32)
        return self._sensor.counts(flat, t, index, self._flight.seed)

    def _frozen_counts(self, index: int) -> Counts:
        """Counts of the last frame before the shutter closed."""
        last = index
        while last > 0 and self._closed(last):
            last -= 1
        if self._last is not None and self._last[0] == last:
            return self._last[1]
        # The frame belongs to another chunk: the same steps as there give the same counts to the last bit.
        self._renderer.forget()
        for earlier in range(last - last % CHUNK, last):
            if not self._closed(earlier):
                self._renderer.frame(self._flight.frame_time(earlier))
        return self._live_counts(last)

    def _closed(self, index: int) -> bool:
        return self._sensor.in_ffc(self._flight.frame_time(index))
