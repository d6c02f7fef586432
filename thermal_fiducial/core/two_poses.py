"""Two poses of a camera that are both possible, in one message: their mean, whose covariance has both.

A square that is small in the image has two poses that explain its corners (the planar ambiguity). The mapper publishes
the mean where nothing that it has shows which one is right, and the filter finds the two in it.
"""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.core.error_model import covariance_of_one_error
from thermal_fiducial.core.geometry.se3 import difference, lever_arm, screwed, so3_exp, turned
from thermal_fiducial.core.measurements import CameraPose, NOTHING_KNOWN, VAGUE
from thermal_fiducial.core.types import FloatArray

#: Difference of chi square that rules out the worse of two poses, or of two markers: odds of e^-10.
DECISIVE = 20.0
#: Two poses are apart if half of the turn between them is as many standard deviations of each; else they are one, which
#: is uncertain. Published with a tenth more, for the rounding of the covariance.
APART = 3.0
_CLEARLY_APART = 1.1 * APART
#: Largest half of a turn between two poses [rad]. Where a pose says nothing of a turn, it claims more.
_LARGEST_HALF = math.pi / 2.0


def mean_of_two(mean: CameraPose, half: FloatArray) -> CameraPose:
    """The mean of two poses whose covariance contains both.

    If the two are not apart, it claims to know nothing of turns across the line of sight: from the front the corners do
    not show about which axis the marker is turned. Only from the mean, which faces the marker, is each pose that they
    allow one turn away; from either of the two it is a roll away as well.

    Parameters
    ----------
    mean : halfway between the two, with the covariance that each has by itself
    half : (6,) screw from the mean to one of the two, in the map [m, rad]; the other one is as far on the other side
    """
    turn = half[3:]
    squared = float(turn @ turn)
    variance = float(turn @ (mean.covariance - mean.map_covariance)[3:, 3:] @ turn) / squared
    ends = (difference(screwed(mean.T_map_camera, step), mean.T_map_camera) for step in (half, -half))
    spread = np.asarray(0.5 * sum(map(covariance_of_one_error, ends)))
    if squared < max(VAGUE**2, _CLEARLY_APART**2 * variance):
        # The marker is on the axis of the screw. The other unknown turn is about the axis through the marker that is
        # across this one and the line of sight.
        to_axis = np.cross(turn, half[:3]) / squared
        across = np.cross(turn, to_axis) / np.linalg.norm(to_axis)
        for unknown in (half, np.concatenate([np.cross(to_axis, across), across])):
            spread += unknown_turn(unknown)
    return mean.widened(spread)


def possible_poses(pose: CameraPose) -> list[CameraPose]:
    """The pose, or the two that it is the mean of if these are apart.

    The largest variance of the mean's attitude is about the axis of the turn between the two: the square of half of
    that turn, and the variance of each pose. The latter is taken to be as large as about the axis across, since the
    outline of a square changes alike with both. Of the distance to the marker both claim as little as the mean. The
    camera moves about the marker as it turns: a pose whose position does not go with the turn, say of a robot that does
    not know its heading, is a single one that is uncertain.
    """
    own = pose.covariance - pose.map_covariance
    if own[3:, 3:].trace() <= VAGUE**2:
        return [pose]
    variances, axes = np.linalg.eigh(own[3:, 3:])
    if not APART**2 * variances[1] < variances[2] < _LARGEST_HALF**2:
        return [pose]
    half = own[:, 3:] @ axes[:, 2] / variances[2] * math.sqrt(variances[2] - variances[1])
    moved = half[:3]
    if moved @ own[:3, :3] @ moved * (1.0 - 1.0 / APART**2) >= (moved @ moved) ** 2:
        return [pose]
    own -= covariance_of_one_error(half)
    # The camera moves along an arc about the marker, whose chord the covariance has.
    half[:3] /= np.sinc(np.linalg.norm(half[3:]) / np.pi)
    return [along_screw(pose, step, own) for step in (half, -half)]


def along_screw(pose: CameraPose, step: FloatArray, own: FloatArray) -> CameraPose:
    """A pose moved by ``step`` (6,) along a screw, with ``own`` (6, 6) in its covariance beside the map's error.

    Errors of the corners stay what they are in the camera, those of the map what they are in the map.
    """
    T = screwed(pose.T_map_camera, step)
    with_map = lever_arm(T[:3, 3] - pose.T_map_camera[:3, 3])
    of_map = with_map @ pose.map_covariance @ with_map.T
    return replace(pose, T_map_camera=T, covariance=turned(own, so3_exp(step[3:])) + of_map, map_covariance=of_map)


def unknown_turn(screw: FloatArray) -> FloatArray:
    """Covariance (6, 6) by a turn along a ``screw`` (6,) of which nothing is known."""
    return covariance_of_one_error(screw, NOTHING_KNOWN / float(np.linalg.norm(screw[3:])))
