"""Simulated detections: corners of markers with errors, without pictures."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.sim.corner_noise import CornerNoise
from thermal_fiducial.sim.thermal_camera import FlightPlan, true_corners


@dataclass(frozen=True)
class CornerFrame:
    """Corners of one frame: the camera's stamp, IDs (N,), pixels (N, 4, 2)."""

    stamp_ns: int
    ids: IntArray
    corners_px: FloatArray


def corner_frames(flight: FlightPlan, noise: CornerNoise) -> list[CornerFrame]:
    """Frames of a flight in which at least one marker is visible."""
    scenario = flight.scenario
    lens = noise.true_lens or scenario.lens
    path = scenario.trajectory(flight.seconds, flight.seed)
    times = np.array([flight.frame_time(index) for index in range(flight.frame_count)])
    frames = []
    for index, T in enumerate(path(times).T_map_body @ scenario.T_body_camera):
        seen = true_corners(lens, scenario.markers, [], T)
        if seen:
            corners = np.array(list(seen.values()))
            corners += np.random.default_rng([flight.seed, 11, index]).normal(0.0, noise.sigma_px, corners.shape)
            frames.append(CornerFrame(flight.stamp_ns(index), np.array(list(seen)), corners))
    return frames
