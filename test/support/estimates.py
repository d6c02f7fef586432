"""Estimates of the filter to test its matrices with."""

from dataclasses import replace

import numpy as np

from support.flights import config
from thermal_fiducial.core.filter.initialization import blank_state
from thermal_fiducial.core.filter.pose_noise import BodyPose, PoseNoise
from thermal_fiducial.core.filter.state import Estimate, SIZE
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.se3 import so3_exp, so3_left_jacobian_inverse, so3_log, transform

#: Far from everything: its systematic error is another one.
ELSEWHERE = BodyPose(transform(np.eye(3), [1e3, 0.0, 0.0]), 1e-4 * np.eye(6))


def difference(state, other):
    """Error coordinates that carry ``state`` to ``other``."""
    rotation = so3_log(state.R_map_body.T @ other.R_map_body)
    J = so3_left_jacobian_inverse(rotation) @ state.R_map_body.T
    extrinsics = other.T_body_camera @ np.linalg.inv(state.T_body_camera)
    phi = so3_log(extrinsics[:3, :3])
    return np.concatenate(
        (
            rotation,
            J @ (other.velocity - state.velocity),
            J @ (other.position - state.position),
            other.bias - state.bias,
            (other.scale - state.scale).ravel(),
            [other.force_delay - state.force_delay],
            other.gravity[:2] - state.gravity[:2],
            [other.time_offset - state.time_offset],
            phi,
            so3_left_jacobian_inverse(phi) @ extrinsics[:3, 3],
            other.systematic - state.systematic,
            se3.screw_difference(other.T_map_markers @ np.linalg.inv(state.T_map_markers), np.eye(4)),
        )
    )


def any_estimate():
    """Somewhere, turned and moving, with a dense covariance."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(SIZE, SIZE)) * 0.01
    state = replace(
        blank_state(config()),
        R_map_body=so3_exp([0.3, -0.2, 1.9]),
        velocity=np.array([1.0, -0.5, 0.2]),
        position=np.array([4.0, 2.0, -1.0]),
        bias=0.01 * rng.normal(size=6),
        scale=0.01 * rng.normal(size=(2, 3, 3)),
        force_delay=0.004,
    )
    return Estimate(1_000, state, A @ A.T, pose_noise=PoseNoise.of(ELSEWHERE))
