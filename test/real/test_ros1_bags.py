"""ROS 1 bags that another project recorded."""

import numpy as np

from thermal_fiducial.files.bags import BagReader


def test_camera_bag(real_data):
    remap = {'/raspicam_node/camera_info': 'thermal/camera_info'}
    with BagReader(real_data / 'ubiquity_fiducials' / 'aruco_images.bag', remap) as bag:
        assert bag.topics['thermal/camera_info'] == 'sensor_msgs/msg/CameraInfo'
        assert bag.message_count(['thermal/camera_info']) == 15
        messages = list(bag.messages())
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    info = next(message.message for message in messages if message.topic == 'thermal/camera_info')
    assert info.header.frame_id == 'raspicam'
    assert info.k.shape == (9,)
    assert info.k[0] > 100.0


def test_transforms_of_a_type_that_only_the_bag_knows(real_data):
    folder = real_data / 'ubiquity_fiducials'
    with BagReader(folder / 'aruco_transforms.bag') as bag:
        (message,) = bag.messages()
    transforms = message.message.transforms
    assert len(transforms) == 7
    assert {str(item.fiducial_id) for item in transforms} <= {'100', '103', '106', '107', '110', '111', '112'}
    rotations = [item.transform.rotation for item in transforms]
    norms = [np.linalg.norm([q.x, q.y, q.z, q.w]) for q in rotations]
    # Unit quaternions, in the double precision that they were recorded in.
    np.testing.assert_allclose(norms, 1.0, atol=1e-9)
