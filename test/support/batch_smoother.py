"""The attainable error: GTSAM over the same IMU samples and camera poses as the filter, with and without the future.

It knows the time offset, and a vertical map. One node a camera pose.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.imu_noise import bias_walks
from thermal_fiducial.core.filter.initialization import blank_state
from thermal_fiducial.core.filter.update import body_pose
from thermal_fiducial.core.geometry.se3 import so3_exp
from thermal_fiducial.core.measurements import CameraPose, ImuSample
from thermal_fiducial.core.types import FloatArray, IntArray

X, V, B = (gtsam.symbol_shorthand.__dict__[name] for name in 'XVB')


@dataclass(frozen=True)
class Flown:
    """What a flight has measured, as factors."""

    config: PoseEkfConfig
    #: (N,) [ns] and (N, 6) IMU samples
    stamps: IntArray
    imu: FloatArray
    #: (M,) instants of the camera poses [ns, clock of the IMU], and these
    times: IntArray
    poses: Sequence[CameraPose]

    @classmethod
    def of(
        cls, config: PoseEkfConfig, samples: Sequence[ImuSample], poses: Sequence[CameraPose], offset: float
    ) -> 'Flown':
        """``offset``: t_imu = t_camera + offset [s]."""
        stamps = np.array([sample.stamp_ns for sample in samples])
        imu = np.array([np.concatenate((s.angular_velocity, s.linear_acceleration)) for s in samples])
        times = np.array([pose.stamp_ns + round(offset * 1e9) for pose in poses])
        inside = (times > stamps[0]) & (times < stamps[-1])
        used = [pose for pose, keep in zip(poses, inside, strict=True) if keep]
        return cls(config, stamps, imu, times[inside], used)

    def nodes(self) -> Iterator[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]]:
        """What each camera pose adds: its factors, and first values of its variables."""
        config = self.config
        T_body_camera = blank_state(config).T_body_camera
        robust = gtsam.noiseModel.mEstimator.Huber.Create(5.0)
        for index, pose in enumerate(self.poses):
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            body = body_pose(pose, T_body_camera, config.pose_noise_scale)
            noise = gtsam.noiseModel.Gaussian.Covariance(body.shape)
            place = gtsam.Pose3(body.T_map_body)
            graph.add(gtsam.PriorFactorPose3(X(index), place, gtsam.noiseModel.Robust.Create(robust, noise)))
            values.insert(X(index), place)
            values.insert(V(index), np.zeros(3))
            values.insert(B(index), gtsam.imuBias.ConstantBias())
            for factor in self._imu_factors(index) if index else self._priors():
                graph.add(factor)
            yield graph, values

    def _priors(self) -> list[gtsam.NoiseModelFactor]:
        config = self.config
        biases = np.repeat((config.initial_accelerometer_bias_std, config.initial_gyroscope_bias_std), 3)
        speed = gtsam.noiseModel.Isotropic.Sigma(3, config.initial_velocity_std)
        return [
            gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(biases)),
            gtsam.PriorFactorVector(V(0), np.zeros(3), speed),
        ]

    def _imu_factors(self, index: int) -> list[gtsam.NoiseModelFactor]:
        """From the pose before: the samples, and the walk of the biases."""
        noise = self.config.imu
        preintegrated = self.integrals()
        for step, dt in self.steps(self.times[index - 1], self.times[index]):
            integrate(preintegrated, step, dt)
        keys = (X(index - 1), V(index - 1), X(index), V(index), B(index - 1))
        walk = np.repeat(bias_walks(noise)[::-1], 3)
        seconds = (self.times[index] - self.times[index - 1]) * 1e-9
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(walk * np.sqrt(seconds))
        still = gtsam.imuBias.ConstantBias()
        return [
            gtsam.ImuFactor(*keys, preintegrated),
            gtsam.BetweenFactorConstantBias(B(index - 1), B(index), still, sigmas),
        ]

    def integrals(self) -> gtsam.PreintegratedImuMeasurements:
        """Of no samples yet."""
        noise = self.config.imu
        params = gtsam.PreintegrationParams.MakeSharedU(self.config.gravity)
        params.setAccelerometerCovariance(noise.accelerometer_noise_density**2 * np.eye(3))
        params.setGyroscopeCovariance(noise.gyroscope_noise_density**2 * np.eye(3))
        params.setIntegrationCovariance(1e-12 * np.eye(3))
        return gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())

    def steps(self, begin: int, end: int) -> list[tuple[FloatArray, float]]:
        """Samples between two instants, interpolated at them, the mean of neighbours over each step [s]."""
        between = self.stamps[(self.stamps > begin) & (self.stamps < end)]
        instants = np.concatenate(([begin], between, [end]))
        seconds = (instants - self.stamps[0]) * 1e-9
        known = (self.stamps - self.stamps[0]) * 1e-9
        at = np.stack([np.interp(seconds, known, column) for column in self.imu.T], axis=1)
        return list(zip(0.5 * (at[:-1] + at[1:]), np.diff(seconds).tolist(), strict=True))


def integrate(preintegrated: gtsam.PreintegratedImuMeasurements, step: FloatArray, dt: float) -> None:
    """Add a step: GTSAM holds the force in the axes of its beginning; the middle is right to second order."""
    preintegrated.integrateMeasurement(so3_exp(0.5 * dt * step[:3]) @ step[3:], step[:3], dt)


def smooth(
    config: PoseEkfConfig, samples: Sequence[ImuSample], poses: Sequence[CameraPose], offset: float
) -> tuple[IntArray, FloatArray]:
    """Instants (N,) [ns, clock of the IMU] and T_map_body (N, 4, 4) of the camera poses, from the whole flight.

    Parameters
    ----------
    offset : t_imu = t_camera + offset [s]
    """
    flown = Flown.of(config, samples, poses, offset)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factors, first in flown.nodes():
        graph.push_back(factors)
        values.insert(first)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-10)
    settings.setAbsoluteErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    return flown.times, np.array([result.atPose3(X(index)).matrix() for index in range(len(flown.poses))])


def follow(
    config: PoseEkfConfig, samples: Sequence[ImuSample], poses: Sequence[CameraPose], offset: float, delay: float
) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) [ns] and T_map_body (N, 4, 4) of the IMU samples, from the poses that have come by then.

    The best that is possible without the future: all poses that came until then are adjusted together with all samples
    (incremental smoothing, every variable linearised anew), and the latest is carried on by the samples after it.

    Parameters
    ----------
    offset : t_imu = t_camera + offset [s]
    delay : from the instant of a pose to its coming [s]
    """
    flown = Flown.of(config, samples, poses, offset)
    settings = gtsam.ISAM2Params()
    # 1 mm, 0.06 deg: with the second update below the errors are those of full linearisation to a ten-thousandth
    settings.setRelinearizeThreshold(1e-3)
    settings.relinearizeSkip = 1
    settings.setFactorization('QR')
    smoother = gtsam.ISAM2(settings)
    came = [*(flown.times + round(delay * 1e9)).tolist(), flown.stamps[-1] + 1]
    stamps, T = [], []
    for index, (factors, first) in enumerate(flown.nodes()):
        smoother.update(factors, first)
        smoother.update()
        bias = smoother.calculateEstimateConstantBias(B(index))
        state = gtsam.NavState(smoother.calculateEstimatePose3(X(index)), smoother.calculateEstimateVector(V(index)))
        preintegrated, time_ns = flown.integrals(), flown.times[index]
        for stamp in flown.stamps[(flown.stamps >= came[index]) & (flown.stamps < came[index + 1])]:
            for step, dt in flown.steps(time_ns, stamp) if stamp > time_ns else ():
                integrate(preintegrated, step, dt)
            time_ns = stamp
            stamps.append(stamp)
            T.append(preintegrated.predict(state, bias).pose().matrix())
    return np.array(stamps), np.array(T)
