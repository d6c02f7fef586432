"""Localize a recorded flight without ROS: ``python localize_bag.py BAG PARAMETERS MAP OUT.tum``."""

from pathlib import Path
import sys

from thermal_fiducial import Camera, ImuSample, load_config, load_dictionary, load_map, Pipeline, read_bag
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation
from thermal_fiducial.files.trajectory_file import tum_line


def main(bag: str, parameters: str, marker_map: str, out: str) -> None:
    """Write the pose of the robot in the map at each IMU sample."""
    config = load_config(parameters, mode='localization')
    pipeline = Pipeline(config, load_dictionary(config.aruco_detector.dictionary), load_map(marker_map))
    with Path(out).open('w') as file:
        for item in read_bag(bag):
            if isinstance(item, Camera):
                pipeline.camera = item
            elif isinstance(item, ImuSample):
                odometry = pipeline.add_imu(item)
                if odometry is not None:
                    T = odometry.T_map_body
                    print(tum_line(item.stamp_ns, T[:3, 3], quaternion_from_rotation(T[:3, :3])), file=file)
            else:
                pipeline.add_image(item.stamp_ns, item.counts)
    print(f'{out}: {pipeline.filter.status}')


if __name__ == '__main__':
    if len(sys.argv) != 5:
        sys.exit('usage: python localize_bag.py BAG PARAMETERS MAP OUT.tum')
    main(*sys.argv[1:])
