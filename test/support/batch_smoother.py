"""The attainable error: a batch smoother (GTSAM) over the same IMU samples and camera poses as the filter.

It sees the whole flight at once, knows the time offset, and a vertical map. One node a camera pose.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.error_state import ErrorStateFilter
from thermal_fiducial.core.filter.initialisation import blank_state
from thermal_fiducial.core.filter.navigation_state import Layout
from thermal_fiducial.core.geometry import so3_exp
from thermal_fiducial.core.measurements import CameraPose, ImuSample
from thermal_fiducial.core.types import FloatArray, IntArray

X, V, B = (gtsam.symbol_shorthand.__dict__[name] for name in 'XVB')


def smooth(
    config: PoseEkfConfig, samples: Sequence[ImuSample], poses: Sequence[CameraPose], offset: float
) -> tuple[IntArray, FloatArray]:
    """Instants (N,) [ns, clock of the IMU] and T_map_body (N, 4, 4) of the camera poses, smoothed.

    Parameters
    ----------
    offset : t_imu = t_camera + offset [s]
    """
    stamps = np.array([sample.stamp_ns for sample in samples])
    imu = np.array([np.concatenate((s.angular_velocity, s.linear_acceleration)) for s in samples])
    times = np.array([pose.stamp_ns + round(offset * 1e9) for pose in poses])
    inside = (times > stamps[0]) & (times < stamps[-1])
    times, used = times[inside], [pose for pose, keep in zip(poses, inside, strict=True) if keep]
    filter_ = ErrorStateFilter(config)
    T_body_camera = blank_state(config, Layout.of(config)).T_body_camera
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    robust = gtsam.noiseModel.mEstimator.Huber.Create(5.0)
    floor = np.repeat((config.attitude_floor**2, config.position_floor**2), 3)
    for index, pose in enumerate(used):
        body = filter_.body_pose(pose, T_body_camera)
        noise = gtsam.noiseModel.Gaussian.Covariance(body.covariance + np.diag(floor))
        place = gtsam.Pose3(body.T_map_body)
        graph.add(gtsam.PriorFactorPose3(X(index), place, gtsam.noiseModel.Robust.Create(robust, noise)))
        values.insert(X(index), place)
        values.insert(V(index), np.zeros(3))
        values.insert(B(index), gtsam.imuBias.ConstantBias())
        if index:
            for factor in _imu_factors(config, stamps, imu, times[index - 1 : index + 1], index):
                graph.add(factor)
    biases = np.repeat((config.initial_accelerometer_bias_std, config.initial_gyroscope_bias_std), 3)
    start = gtsam.noiseModel.Diagonal.Sigmas(biases)
    graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), start))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-10)
    settings.setAbsoluteErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    return times, np.array([result.atPose3(X(index)).matrix() for index in range(len(used))])


def _imu_factors(
    config: PoseEkfConfig, stamps: IntArray, imu: FloatArray, ends: IntArray, index: int
) -> tuple[gtsam.ImuFactor, gtsam.BetweenFactorConstantBias]:
    """Samples between two instants, interpolated at them, the mean of neighbours over each step; walk of the biases."""
    noise = config.imu
    params = gtsam.PreintegrationParams.MakeSharedU(config.gravity)
    params.setAccelerometerCovariance(noise.accelerometer_noise_density**2 * np.eye(3))
    params.setGyroscopeCovariance(noise.gyroscope_noise_density**2 * np.eye(3))
    params.setIntegrationCovariance(1e-12 * np.eye(3))
    between = stamps[(stamps > ends[0]) & (stamps < ends[1])]
    instants = np.concatenate((ends[:1], between, ends[1:]))
    seconds = (instants - stamps[0]) * 1e-9
    at = np.stack([np.interp(seconds, (stamps - stamps[0]) * 1e-9, column) for column in imu.T], axis=1)
    preintegrated = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())
    for step, dt in zip(0.5 * (at[:-1] + at[1:]), np.diff(seconds), strict=True):
        # GTSAM holds the force in the axes of the step's beginning; the middle is right to second order.
        force = so3_exp(0.5 * dt * step[:3]) @ step[3:]
        preintegrated.integrateMeasurement(force, step[:3], float(dt))
    keys = (X(index - 1), V(index - 1), X(index), V(index), B(index - 1))
    walk = np.repeat((noise.accelerometer_random_walk, noise.gyroscope_random_walk), 3)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(walk * np.sqrt(seconds[-1] - seconds[0]))
    still = gtsam.imuBias.ConstantBias()
    return (
        gtsam.ImuFactor(*keys, preintegrated),
        gtsam.BetweenFactorConstantBias(B(index - 1), B(index), still, sigmas),
    )
