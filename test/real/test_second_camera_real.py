"""A second real camera before the board: its poses, as poses of the first, are as good as those."""

import numpy as np
import pytest
from support import real_flights
from support.corner_runs import rms

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import seen_from

pytestmark = [pytest.mark.nightly, pytest.mark.usefixtures('real_data')]


def test_the_second_camera_stands_in_for_the_first():
    """Six seconds of the board: places of the first camera by either, against the reference."""
    first, second = (real_flights.april_board(camera, seconds=6.0) for camera in ('cam0', 'cam1'))
    T_second_first = inverse(second.T_body_camera) @ first.T_body_camera
    errors = {}
    for flight, T_camera_first in ((first, np.eye(4)), (second, T_second_first)):
        config = MarkerMapperConfig(mode='localization', marker_size=flight.marker_size)
        mapper = MarkerMapper(config, flight.marker_map)
        poses = [mapper.process(stamp, rows, flight.camera).pose for stamp, rows in flight.frames.items()]
        within = [p for p in poses if p and flight.reference_ns[0] <= p.stamp_ns <= flight.reference_ns[-1]]
        seen = [seen_from(pose, T_camera_first) for pose in within]
        truth = flight.truth([pose.stamp_ns for pose in seen]) @ first.T_body_camera
        apart = difference(np.stack([pose.T_map_camera for pose in seen]), truth)
        nees = np.mean([d @ np.linalg.solve(pose.covariance, d) for d, pose in zip(apart, seen, strict=True)])
        errors[flight.name] = rms(np.linalg.norm(apart[:, :3], axis=1)), nees
    (own, _), (others, others_nees) = errors.values()
    # One recording before one board: what is different are the lens, and extrinsics that a calibration left.
    assert others < 1.5 * own
    # Six degrees of freedom.
    assert others_nees < 6.0
