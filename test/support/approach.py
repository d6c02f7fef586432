"""A flight up to one marker until it is larger than the image, as in a landing; and what the stages make of it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from support.scenes import camera_of, detector_of
from thermal_fiducial.config import ArucoDetectorConfig, MarkerMapperConfig, PoseEkfConfig
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.pipeline import Pipeline, PipelineConfig
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scenario import named, Scenario, with_contrast
from thermal_fiducial.sim.scene import Marker
from thermal_fiducial.sim.spline_trajectory import Flight, smooth_step, SplineTrajectory
from thermal_fiducial.sim.thermal_camera import render_frames, simulate_imu

__all__ = ['Approach', 'camera_of', 'detector_of', 'fly', 'scenario']

#: A quarter of the pixels of a Tau 2, with as wide a view.
LENS = Lens((221.0, 220.5), (161.3, 126.4), 'equidistant', (0.0143, -0.0218, 0.0312, -0.0174), 320, 256)
#: Frames arrive so late [ns].
DELAY_NS = 30_000_000


@dataclass(frozen=True)
class Approach(Flight):
    """From ``far`` to ``near`` [m] before the marker at ``wall`` [m], swaying there, and off to the side at the end.

    Parameters
    ----------
    begins, lasts : of the approach [s]
    drift : how far it moves to the side in the last two seconds [m]
    """

    wall: float = 3.0
    far: float = 1.7
    near: float = 0.55
    begins: float = 1.5
    lasts: float = 3.0
    drift: float = 0.15

    def trajectory(self, seconds: float, seed: int) -> SplineTrajectory:
        """The flight of this seed."""
        t = np.linspace(-0.5, seconds + 0.5, round(20 * (seconds + 1)) + 1)
        phase = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, 6)
        waves = np.sin(2.0 * np.pi * t[:, None] / np.array([3.1, 2.3, 1.9, 2.7, 1.7, 2.9]) + phase)
        distance = self.far + (self.near - self.far) * smooth_step(t, self.begins, self.lasts)
        sway = np.array([0.02, 0.04, 0.03]) * waves[:, :3] * distance[:, None]
        position = np.stack([self.wall - distance, np.zeros_like(t), np.full_like(t, 1.25)], axis=1) + sway
        position[:, 1] += self.drift * smooth_step(t, seconds - 2.0, 1.5)
        return SplineTrajectory(t, position, Rotation.from_rotvec(np.array([0.06, 0.05, 0.05]) * waves[:, 3:]))


def scenario(contrast: float = 8.0, lens: Lens = LENS, **flight: float) -> Scenario:
    """One marker of 0.5 m that is level with the camera."""
    rig = named('wall')
    marker = Marker(7, (Approach.wall, 0.0, 1.22), 180.0, 2.0, 9.0, 0.5)
    sensor = replace(rig.sensor, ffc_period=0.0)
    return with_contrast(replace(rig, markers=(marker,), lens=lens, flight=Approach(**flight), sensor=sensor), contrast)


def fly(flown: Scenario, seconds: float, seed: int = 3, **changes):
    """Every frame's truth with its result, and the filter's poses: lists of (SimFrame, FrameResult), Odometry."""
    rig = {'camera_position': flown.camera_position, 'camera_orientation': flown.camera_orientation}
    config = PipelineConfig(
        aruco_detector=ArucoDetectorConfig(marker_size=0.5, **rig, **changes),
        marker_mapper=MarkerMapperConfig(mode='localization', **rig),
        pose_ekf=PoseEkfConfig(**rig),
    )
    markers = {m.id: MapMarker(m.id, m.size, True, m.T_map_marker) for m in flown.markers}
    pipeline = Pipeline(config, load_dictionary(flown.dictionary), MarkerMap(markers), camera_of(flown))
    imu = simulate_imu(flown, seconds, seed)
    frames = list(render_frames(flown, seconds, seed))
    results, poses, waiting = [], [], list(frames)
    for k, stamp_ns in enumerate(imu.stamps_ns.tolist()):
        while waiting and waiting[0].stamp_ns + DELAY_NS <= stamp_ns:
            frame = waiting.pop(0)
            results.append((frame, pipeline.add_image(frame.stamp_ns, frame.counts)))
        odometry = pipeline.add_imu(ImuSample(stamp_ns, imu.angular_velocity[k], imu.linear_acceleration[k]))
        poses += [] if odometry is None else [odometry]
    return results, poses
