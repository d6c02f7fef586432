"""A flight through ``Pipeline``, as samples and frames arrive, and what its poses and its map are worth."""

from collections.abc import Iterator, Mapping
import heapq
from itertools import takewhile
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rigs import inertial, motion, room
from rigs.bolometer import Bolometer
from rigs.display import shown
from rigs.motion import Path
from rigs.rig import AS_DRAWN, Rig, SECONDS
from rigs.room import Room
from rigs.score import Score, Worth
from thermal_fiducial import Camera, ImuSample, load_dictionary, MarkerMap, Odometry, Pipeline
from thermal_fiducial.core.detection.patterns import Dictionary
from thermal_fiducial.core.error_model import READOUT_AS_DECLARED
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.pipeline import PipelineConfig

#: The known map, and mapping from the marker in the middle.
MODES = ('localization', 'mapping')
#: Stamp of the beginning of a flight.
START_NS = 1_700_000_000_000_000_000
#: Poses count from here on [s]: velocity and tilt are known by then.
SETTLED = 2.0
#: A marker of at least this is to be found [px].
LEGIBLE_PX = 14.0


class Arrival(NamedTuple):
    """A sample (6,) or a frame (H, W) that arrives at ``when``, of the instant ``t``, with the stamp ``stamp`` [s]."""

    when: float
    t: float
    stamp: float
    value: np.ndarray


class Flown:
    """A pipeline in flight, beside the truth; ``as_drawn``: its parameters say how large the rig's errors are."""

    def __init__(
        self, rig: Rig, scene: Room, path: Path, dictionary: Dictionary, mode: str, as_drawn: bool = False
    ) -> None:
        self._rig, self._room, self._path, self._mode = rig, scene, path, mode
        known = scene.plates if mode == 'localization' else dict([next(iter(scene.plates.items()))])
        markers = {i: MapMarker(i, plate.size, True, plate.T_map_plate) for i, plate in known.items()}
        config = _config(rig, mode, AS_DRAWN if as_drawn else {})
        self.pipeline = Pipeline(config, dictionary, MarkerMap(markers, dictionary=rig.task.dictionary), _camera(rig))
        # With each, whether the filter declared itself lost.
        self._states: list[tuple[Odometry, bool]] = []
        self._in_view = self._found = self._false = 0

    def take(self, arrival: Arrival) -> None:
        """Hand over a sample or a frame."""
        stamp_ns = START_NS + round(1e9 * arrival.stamp)
        if arrival.value.ndim == 2:
            self._look(arrival.t, self.pipeline.add_image(stamp_ns, arrival.value).markers)
            return
        state = self.pipeline.add_imu(ImuSample(stamp_ns, arrival.value[:3], arrival.value[3:]))
        if state is not None:
            self._states.append((state, self.pipeline.filter.lost))

    def _look(self, t: float, markers: np.ndarray | None) -> None:
        if markers is None:
            return
        seen = set(markers['id'].tolist())
        legible = _legible(self._rig, self._room, self._path.T_map_body(t) @ self._rig.T_body_camera)
        self._in_view += len(legible)
        self._found += len(legible & seen)
        self._false += len(seen - self._room.plates.keys())

    def score(self) -> Score:
        """After the last arrival."""
        self.pipeline.finish()
        settled = [(state, lost) for state, lost in self._states if _seconds(state) >= SETTLED]
        counted = [state for state, lost in settled if not lost]
        mapped, plates = self.pipeline.mapper.map.markers, self._room.plates
        placed = [m for m in mapped.values() if not m.fixed and m.id in plates]
        return Score(
            mode=self._mode,
            poses=Worth.of([(self._path.T_map_body(_seconds(o)), o.T_map_body, o.pose_covariance) for o in counted]),
            markers=Worth.of([(plates[m.id].T_map_plate, m.T_map_marker, m.covariance) for m in placed]),
            lost=1.0 - len(counted) / max(len(settled), 1),
            resets=self.pipeline.filter.resets,
            found=self._found / self._in_view if self._in_view else 1.0,
            false=self._false,
            false_mapped=len(mapped.keys() - plates.keys()),
        )


def _seconds(state: Odometry) -> float:
    return (state.stamp_ns - START_NS) * 1e-9


def _legible(rig: Rig, scene: Room, T_map_camera: np.ndarray) -> set[int]:
    """IDs of the markers that are wholly in the image and large enough."""
    found = set()
    for marker_id, plate in scene.plates.items():
        T = np.linalg.inv(T_map_camera) @ plate.T_map_plate
        corners = plate.corners @ T[:3, :3].T + T[:3, 3]
        if rig.lens.sees(corners):
            pixels = rig.lens.project(corners)
            if np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1).min() >= LEGIBLE_PX:
                found.add(marker_id)
    return found


def _camera(rig: Rig) -> Camera:
    lens = rig.calibrated
    return Camera(lens.width, lens.height, lens.matrix, 'plumb_bob', np.append(lens.distortion, 0.0))


def _config(rig: Rig, mode: str, declared: Mapping[str, float]) -> PipelineConfig:
    """Defaults but for what a rig is, as calibrated, and for what is ``declared`` of its errors."""
    T = rig.T_calibrated
    return PipelineConfig.from_mapping(
        {
            'mode': mode,
            'dictionary': rig.task.dictionary,
            'marker_size': rig.task.size,
            'camera_position': T[:3, 3].tolist(),
            'camera_orientation': Rotation.from_matrix(T[:3, :3]).as_quat().tolist(),
            # A global shutter, as the calibration that has found the camera's place shows.
            'readout_time_std': READOUT_AS_DECLARED,
            'imu.gyroscope_noise_density': float(rig.imu.density[0]),
            'imu.accelerometer_noise_density': float(rig.imu.density[3]),
        }
        | dict(declared)
    )


def arrivals(rig: Rig, scene: Room, path: Path) -> Iterator[Arrival]:
    """Samples and frames in the order of their arrival."""
    imu = (Arrival(t, t, t, reading) for t, reading in inertial.samples(rig, path))
    return heapq.merge(imu, _frames(rig, scene, path), key=lambda arrival: arrival.when)


def _frames(rig: Rig, scene: Room, path: Path) -> Iterator[Arrival]:
    link, rng = rig.link, rig.rng('link')
    last = 0.0
    for t, image in shown(rig, Bolometer(rig, scene, path).frames()):
        late, wrong = link.delay + abs(rng.normal(0.0, link.scatter)), rng.normal(0.0, link.jitter)
        if rng.random() >= link.loss:
            # A frame waits for those before it.
            last = max(last, t + late)
            yield Arrival(last, t, t - link.offset + wrong, image)


def fly(seed: int, until: float = SECONDS, as_drawn: bool = False) -> tuple[str, list[Score]]:
    """Description of the rig of a seed, and its scores in each mode, of a flight until then [s].

    ``as_drawn``: with parameters that say how large the rig's errors are, where the defaults claim more.
    """
    # Each core has a flight of its own.
    cv2.setNumThreads(1)
    rig = Rig(seed)
    dictionary = load_dictionary(rig.task.dictionary)
    scene, path = room.drawn(rig, dictionary.bits), motion.drawn(rig)
    flown = [Flown(rig, scene, path, dictionary, mode, as_drawn) for mode in MODES]
    for arrival in takewhile(lambda arrival: arrival.when < until, arrivals(rig, scene, path)):
        for flight in flown:
            flight.take(arrival)
    return str(rig), [flight.score() for flight in flown]
