"""Fuse your own poses with an IMU: ``python fuse_poses.py BAG POSES.tum OUT.tum``.

BAG holds ``imu/data``. POSES.tum holds poses of the IMU in the map from anything that finds them: motion capture, SLAM.
"""

from pathlib import Path
import sys

import numpy as np

from thermal_fiducial import CameraPose, ImuSample, load_config, PoseEkf, read_bag
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.files.trajectory_file import load_tum, tum_line

COVARIANCE = np.diag([0.005**2] * 3 + [0.005**2] * 3)  # of each pose: 5 mm, 5 mrad


def main(bag: str, poses: str, out: str) -> None:
    """Write the fused pose at each IMU sample."""
    # What the poses are of, the filter calls the camera: here it is the IMU itself.
    config = load_config(camera_position=[0.0, 0.0, 0.0], camera_orientation=[0.0, 0.0, 0.0, 1.0])
    ekf = PoseEkf(config.pose_ekf)
    stamps, positions, quaternions = load_tum(poses)
    T_map_camera = transform_from_quaternion(positions, quaternions)
    records: list[ImuSample | CameraPose] = [item for item in read_bag(bag) if isinstance(item, ImuSample)]
    records += [CameraPose(int(stamp), T, COVARIANCE) for stamp, T in zip(stamps, T_map_camera, strict=True)]
    with Path(out).open('w') as file:
        for item in sorted(records, key=lambda record: record.stamp_ns):
            if isinstance(item, CameraPose):
                ekf.add_pose(item)
            elif (odometry := ekf.add_imu(item)) is not None:
                T = odometry.T_map_body
                print(tum_line(item.stamp_ns, T[:3, 3], quaternion_from_rotation(T[:3, :3])), file=file)


if __name__ == '__main__':
    if len(sys.argv) != 4:
        sys.exit('usage: python fuse_poses.py BAG POSES.tum OUT.tum')
    main(*sys.argv[1:])
