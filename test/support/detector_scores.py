"""How well a detector does on rendered frames, against their truth."""

from dataclasses import dataclass

import cv2
import numpy as np

from support.scenes import motion_prior
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import corner_covariances, corners_px, Odometry

#: Markers that are wholly in the image and whose shortest side is at least so long should be found [px].
SMALLEST_SIDE = 14.0
#: A detection is a false one if its shape is farther off than this, or its place (the lag moves markers) [px].
FALSE_SHAPE, FALSE_PLACE = 6.0, 15.0
#: The odometry that guides: the truth at the last IMU samples with such errors [m], [rad], [m/s], [rad/s].
ODOMETRY_ERRORS = (0.005, 0.002, 0.02, 0.005)
ODOMETRY_AGES = 0.005 * np.arange(8)[::-1] + 0.004
#: A pose of a marker that is turned farther than this is of the wrong branch [deg].
FLIPPED_DEG = 10.0


def odometry_before(frame, motion_at, rng):
    """What a filter would have said just before the frame: states of 200 Hz, all with the error of the last.

    ``motion_at`` gives the true motion at seconds.
    """
    position, attitude, speed = (sigma * rng.standard_normal(3) for sigma in ODOMETRY_ERRORS[:3])
    pose_covariance, twist_covariance = (
        np.diag([a**2] * 3 + [b**2] * 3) for a, b in (ODOMETRY_ERRORS[:2], ODOMETRY_ERRORS[2:])
    )
    states = []
    for age in ODOMETRY_AGES:
        motion = motion_at([frame.seconds - age])
        T = motion.T_map_body[0].copy()
        T[:3, 3] += position
        T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(attitude)[0]
        velocity = motion.rotation.inv().apply(motion.velocity)[0] + speed
        rate = motion.angular_velocity_body[0] + ODOMETRY_ERRORS[3] * rng.standard_normal(3)
        stamp_ns = frame.stamp_ns - round(age * 1e9)
        states.append(Odometry(stamp_ns, T, velocity, rate, pose_covariance, twist_covariance))
    return motion_prior(*states)


def due(frame):
    """IDs of the markers that should be found."""
    sides = {
        marker_id: np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()
        for marker_id, corners in frame.corners_px.items()
    }
    return [marker_id for marker_id, side in sides.items() if side >= SMALLEST_SIDE]


def is_the_marker(error):
    """Whether a detection that is off by ``error`` (4, 2) [px] is one of the marker."""
    place = error.mean(axis=0)
    shape = np.linalg.norm(error - place, axis=1)
    return bool(np.linalg.norm(place) < FALSE_PLACE and shape.mean() < FALSE_SHAPE)


@dataclass
class DetectorScore:
    """Of the rows of some frames: error of the corners' shape, what it is over its covariance, and counts."""

    squared: float = 0.0
    normalised: float = 0.0
    seen: int = 0
    wanted: int = 0
    found: int = 0
    false: int = 0
    flipped: int = 0

    def add(self, frame, rows, poses):
        """One frame; ``poses`` has T_camera_marker of all markers that there are, by ID.

        Of markers that are not wholly in the image only whether they are found counts, and the attitude.
        """
        self.wanted += len(due(frame))
        for row, corners, covariances in zip(rows, corners_px(rows), corner_covariances(rows), strict=True):
            marker_id = int(row['id'])
            truth = frame.corners_px.get(marker_id)
            error = None if truth is None else corners - truth
            if marker_id not in poses or (error is not None and not is_the_marker(error)):
                self.false += 1
                continue
            self.found += marker_id in due(frame)
            R = se3.rotation_from_quaternion([row[name] for name in ('qx', 'qy', 'qz', 'qw')])
            self.flipped += np.degrees(se3.rotation_angle(R.T @ poses[marker_id][:3, :3])) > FLIPPED_DEG
            self.seen += 1
            if error is not None:
                shape = error - error.mean(axis=0)
                self.squared += float(np.mean(shape**2))
                self.normalised += float(np.einsum('ki,kij,kj->', shape, np.linalg.inv(covariances), shape))

    @property
    def rms_px(self):
        """Error of the shape, per axis."""
        return float(np.sqrt(self.squared / max(self.seen, 1)))

    @property
    def nees(self):
        """Per degree of freedom: 6 of a shape."""
        return self.normalised / (6.0 * max(self.seen, 1))

    @property
    def rate(self):
        """Share of the markers that should be found."""
        return self.found / max(self.wanted, 1)
