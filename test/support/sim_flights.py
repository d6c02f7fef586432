"""Simulated flights that begin with the corners, as :class:`CornerFlight`."""

from functools import cache

import numpy as np

from support.corner_runs import CornerFlight
from thermal_fiducial.cli.simulate_corners import simulated_recording
from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.thermal_camera import plan


@cache
def simulated(name, seed=0, seconds=None) -> CornerFlight:
    """The flight of a scenario that has no pictures, with the true map and the densities of its IMU's noise."""
    scenario = named(name)
    recording = simulated_recording(plan(name, seconds, seed), scenario.corner_noise)
    rig, frames = recording.rig, {}
    for frame in recording.corners:
        covariances = np.square(frame.sigma_px)[:, None, None, None] * np.broadcast_to(
            np.eye(2), (len(frame.ids), 4, 2, 2)
        )
        sizes = np.full(len(frame.ids), rig.marker_size)
        frames[frame.stamp_ns] = rows_from_corners(frame.ids, frame.corners_px, covariances, sizes, rig.camera)
    noise = scenario.imu.noise
    # Of a Gauss-Markov process with a time of 2 s, its deviation times the root of 2 / 2 s: the walk that drives it.
    return CornerFlight(
        f'{name}, seed {seed}',
        recording.samples,
        frames,
        rig.camera,
        rig.T_body_camera,
        MarkerMap({m.id: MapMarker(m.id, m.size, True, m.T_map_marker) for m in scenario.markers}),
        *recording.truth,
        rig.marker_size,
        ImuNoise(
            gyroscope_noise_density=noise.gyroscope_noise_density,
            accelerometer_noise_density=noise.accelerometer_noise_density,
            gyroscope_random_walk=noise.gyroscope_random_walk,
            accelerometer_random_walk=noise.accelerometer_random_walk,
            gyroscope_instability=scenario.imu.gyroscope_instability,
            accelerometer_instability=scenario.imu.accelerometer_instability,
        ),
        rig.time_offset,
    )
