"""The camera in the map from all known markers of a frame jointly: steps 3 to 6 of Algorithm 1.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018.
"""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.core.error_model import covariance_of_one_error, decision_weights, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import CameraFit
from thermal_fiducial.core.geometry.se3 import difference, inverse, screw_difference, turn_between
from thermal_fiducial.core.mapping.joint_fit import Alternative, JointFit, SurveyedFit
from thermal_fiducial.core.mapping.located import Location, Refusal, Sight
from thermal_fiducial.core.mapping.marker_views import SAME_POSE, Viewpoint
from thermal_fiducial.core.measurements import CameraPose, VAGUE
from thermal_fiducial.core.two_poses import DECISIVE, mean_of_two, unknown_turn
from thermal_fiducial.core.types import FloatArray

# Largest number of markers that give initial poses, the largest ones; all take part in their ranking.
_PROPOSERS = 4
# Standard deviation of a rotation beyond which the linearisation of a fit without odometry means nothing [rad].
_MEANINGLESS = 1.0


def locate(
    stamp_ns: int, sight: Sight, camera: Camera, errors: SystematicErrors, odometry: CameraPose | None = None
) -> Location | Refusal:
    """Camera pose from N known markers.

    Parameters
    ----------
    sight : the markers and their corners
    odometry : the camera by odometry

    Returns
    -------
    The location, or the reason for which there is none.
    """
    fit = CameraFit(sight.observed.corners, sight.observed.covariances, sight.points, camera)
    hypotheses = _hypotheses(sight, odometry)
    if not len(hypotheses):
        return Refusal('no usable pose of any known marker')
    hypotheses = hypotheses[np.argsort(fit.costs(hypotheses), kind='stable')]
    kind = SurveyedFit if sight.surveyed.any() else JointFit
    frame = kind(stamp_ns, sight, camera, errors, fit)
    # Steps 3 and 4: the pose from all markers jointly, weighted by the map.
    by_map = frame.map_weights(hypotheses[0])
    T = fit.solve(hypotheses[:1], by_map)[0][0]
    reprojection = sight.reprojected(camera, T)
    shown = np.isfinite(reprojection.errors_px)
    if not shown.all():
        # A marker that the camera could not show is not where the map has it. The others give the pose, if most are.
        if 2 * np.count_nonzero(shown) > len(shown):
            return locate(stamp_ns, sight.only(shown), camera, errors, odometry)
        return Refusal(f'no camera pose explains {sight.names}', compared=(sight, reprojection))
    # Steps 5 and 6: refined with the weights of their errors.
    found = frame.refined(T, reprojection, frame.weights(reprojection, by_map))
    if found is None:
        return Refusal(f'the pose from {sight.names} is not determined')
    other = frame.alternative(found, hypotheses)
    if odometry is not None:
        return found if other is None and found.rotation_std <= VAGUE else _by_odometry(frame, found, other, odometry)
    if other is None:
        return found
    return _either(frame, found, other) if other.is_minimum else _widened(found, other)


def _by_odometry(frame: JointFit, found: Location, other: Alternative | None, odometry: CameraPose) -> Location:
    """What the corners say of the camera where odometry has it: at the likeliest pose by both.

    Corners that allow two poses say little of the turn that lies between the two. The fit to the corners alone ends at
    one of them, at a claim that holds there only, and on that side of the line of sight on which odometry is: the mean
    of many frames would confirm an error of the odometry (the iterated Kalman filter linearises at the likeliest pose:
    B. Bell, F. Cathey, IEEE TAC 1993).
    """
    weights = frame.decisive_weights(found)
    starts = [found.pose.T_map_camera] + ([] if other is None else [other.T_map_camera])
    ends = sorted(filter(None, (frame.likeliest(T, odometry, weights) for T in starts)), key=lambda end: end[0])
    location = frame.measured(ends[0][1], weights) if ends else None
    if location is None:
        return found
    for cost, T in ends[1:]:
        excess = cost - ends[0][0]
        if excess < DECISIVE and turn_between(T, ends[0][1]) > SAME_POSE:
            # Odometry must not settle it twice, in the mapper and in the filter.
            location = location.unsettled(unknown_turn(screw_difference(T, location.pose.T_map_camera)))
    return location


def _widened(found: Location, other: Alternative) -> Location:
    """A location whose covariance has what another pose adds that is likelier than by the covariance.

    Where the two planar poses merge, chi square hardly grows from one to the other; to first order it grows with the
    square of the distance.
    """
    apart, covariance = difference(other.T_map_camera, found.pose.T_map_camera), found.pose.covariance
    expected = float(apart @ np.linalg.solve(covariance, apart))
    share = max(math.exp(-0.5 * other.excess) - math.exp(-0.5 * expected), 0.0)
    return found.unsettled(covariance_of_one_error(apart, math.sqrt(share)))


def _either(frame: JointFit, found: Location, other: Alternative) -> Location | Refusal:
    """The mean of two poses that the corners allow, unless the other one hardly fits.

    The map learns nothing from the frame. The filter, which has gravity and follows both over time, finds the two in
    the mean.
    """
    T = other.T_map_camera
    second = frame.refined(T, frame.sight.reprojected(frame.camera, T), found.weights, found.noise_factor)
    # One that hardly fits at all ends anywhere.
    if second is None or second.rotation_std > _MEANINGLESS:
        return found
    chi2 = frame.fit.costs(np.stack([found.pose.T_map_camera, second.pose.T_map_camera]))
    chi2 *= decision_weights(frame.sight.noise_px, frame.sight.observed.readout_px).min()
    both = Viewpoint.either(found.viewpoint, second.viewpoint, chi2)
    likelier, less_likely = (found, second) if chi2[0] <= chi2[1] else (second, found)
    pose = _mean(likelier, less_likely)
    why = f'planar ambiguity of {frame.sight.names} unsettled'
    return Refusal(why, both, pose=pose, compared=likelier.compared)


def _mean(likelier: Location, less_likely: Location) -> CameraPose:
    """The pose halfway along the screw from one of two possible poses to the other, with both in its covariance.

    Errors across the line of sight have opposite signs in the two, so the mean of both covariances has none of their
    correlations with the others.
    """
    T_other = less_likely.pose.T_map_camera
    mean = likelier.moved(0.5 * screw_difference(T_other, likelier.pose.T_map_camera), np.zeros((6, 6))).pose
    first, other = (pose.covariance - pose.map_covariance for pose in (likelier.pose, less_likely.pose))
    at_own = replace(mean, covariance=0.5 * (first + other) + mean.map_covariance)
    return mean_of_two(at_own, screw_difference(T_other, mean.T_map_camera))


def _hypotheses(sight: Sight, prior: CameraPose | None) -> FloatArray:
    """Initial camera poses (H, 4, 4): both planar poses of the largest markers and the prior."""
    largest = np.argsort(-np.ptp(sight.observed.corners, axis=1).sum(axis=-1), kind='stable')[:_PROPOSERS]
    poses = (sight.T_map_marker[largest, None] @ inverse(sight.observed.branches[largest])).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    return np.asarray(poses if prior is None else np.concatenate([poses, prior.T_map_camera[None]]))
