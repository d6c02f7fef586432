"""Messages to numpy and back: nothing is lost, and what cannot be used is said."""

from array import array

from geometry_msgs.msg import Pose, PoseWithCovarianceStamped, Quaternion
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2, PointField, RegionOfInterest
from support import messages

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.measurements import CORNER_COVARIANCE_FIELDS, MAP_DTYPE, MARKER_DTYPE, Odometry
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.ros.messages import clouds, convert, message_bytes

STAMP = 1_700_000_000_123_456_789
HEAD = convert.header(STAMP, 'frame')


def sent(message):
    """What a subscriber gets of ``message``."""
    return deserialize_message(serialize_message(message), type(message))


def rows_of(dtype, count, seed=0):
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, dtype)
    for name in dtype.names:
        rows[name] = rng.integers(1, 200, count) if dtype[name].kind == 'u' else rng.normal(size=count)
        if name.endswith(('uu', 'vv', 'sigma_px')):
            rows[name] = 0.1 + np.abs(rows[name])
    return rows


def test_stamps_keep_their_nanoseconds():
    assert convert.stamp_ns(sent(HEAD).stamp) == STAMP
    assert HEAD.frame_id == 'frame'


# --- images -------------------------------------------------------------------------------------------


def raw_image(pixels, encoding, big=False, padding=0):
    data = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<')).view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(data, ((0, 0), (0, padding)), constant_values=99)
    height, width = pixels.shape
    return Image(
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=data.shape[1],
        data=array('B', data.tobytes()),
    )


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize(
    ('encoding', 'big'),
    [('mono16', False), ('mono16', True), ('16UC1', False), ('16UC1', True), ('mono8', False), ('8UC1', True)],
)
def test_images_of_any_byte_order_and_row_step(encoding, big, padding):
    dtype = np.uint8 if '8' in encoding else np.uint16
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (5, 7)).astype(dtype)
    taken = image_to_array(sent(raw_image(pixels, encoding, big, padding)))
    np.testing.assert_array_equal(taken, pixels)
    assert taken.dtype == dtype
    assert taken.dtype.isnative
    assert taken.flags.c_contiguous


def test_a_last_row_without_its_padding_is_whole():
    message = raw_image(np.arange(12, dtype=np.uint16).reshape(3, 4), 'mono16', padding=4)
    message.data = message.data[:-4]
    np.testing.assert_array_equal(image_to_array(message), np.arange(12).reshape(3, 4))


@pytest.mark.parametrize(
    'changes',
    [
        {'encoding': 'rgb8'},
        {'encoding': ''},
        {'height': 4},
        {'width': 5},
        {'step': 7},
        {'step': 0},
        {'height': 0, 'data': array('B')},
        {'data': array('B')},
    ],
)
def test_an_image_whose_sizes_do_not_fit_is_refused(changes):
    message = raw_image(np.arange(12, dtype=np.uint16).reshape(3, 4), 'mono16')
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match='image'):
        image_to_array(message)


@pytest.mark.parametrize(('shape', 'dtype', 'encoding'), [((3, 4), 'u2', 'mono16'), ((3, 4), 'u1', 'mono8')])
def test_images_come_back(shape, dtype, encoding):
    pixels = np.random.default_rng(0).integers(0, 255, shape).astype(dtype)
    message = sent(convert.image(pixels, HEAD))
    assert message.encoding == encoding
    assert message.header == HEAD
    np.testing.assert_array_equal(image_to_array(message), pixels)


def test_a_picture_in_colour():
    pixels = np.random.default_rng(0).integers(0, 255, (3, 4, 3)).astype(np.uint8)
    message = sent(convert.image(pixels, HEAD))
    assert (message.encoding, message.step) == ('bgr8', 12)
    assert bytes(message.data) == pixels.tobytes()


# --- cameras ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [('plumb_bob', 5), ('rational_polynomial', 8), ('equidistant', 4)],
)
def test_cameras_come_back(model, coefficients):
    D = 0.01 * np.arange(1, coefficients + 1)
    camera = Camera(640, 512, np.array([[440.4, 0.0, 320.5], [0.0, 441.0, 255.2], [0.0, 0.0, 1.0]]), model, D)
    assert convert.camera(sent(convert.camera_info(camera, HEAD))).matches(camera)


@pytest.mark.parametrize(('name', 'model'), [('fisheye', 'equidistant'), ('radtan', 'plumb_bob'), ('', 'plumb_bob')])
def test_drivers_copy_names_of_models_from_files_of_other_tools(name, model):
    camera = Camera(640, 512, np.array([[440.4, 0.0, 320.5], [0.0, 441.0, 255.2], [0.0, 0.0, 1.0]]), model, [0.1])
    message = convert.camera_info(camera, HEAD)
    message.distortion_model = name
    assert convert.camera(message).matches(camera)


def test_a_region_of_interest_may_be_the_whole_image():
    camera = Camera(640, 512, np.array([[440.4, 0.0, 320.5], [0.0, 441.0, 255.2], [0.0, 0.0, 1.0]]))
    message = convert.camera_info(camera, HEAD)
    message.roi = RegionOfInterest(width=640, height=512)
    assert convert.camera(message).matches(camera)


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (CameraInfo(width=640, height=512), 'not calibrated'),
        (CameraInfo(width=640, height=512, distortion_model='thin_prism', k=np.eye(3).ravel()), 'thin_prism'),
        (CameraInfo(width=0, height=512, k=np.eye(3).ravel()), '0x512'),
        (CameraInfo(width=640, height=512, k=np.eye(3).ravel(), binning_x=2), 'binned'),
        (CameraInfo(width=640, height=512, k=np.eye(3).ravel(), roi=RegionOfInterest(width=320)), 'cropped'),
    ],
)
def test_a_camera_info_without_a_usable_calibration_is_refused(message, reason):
    with pytest.raises(InputError, match=reason):
        convert.camera(message)


# --- clouds -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('count', [0, 1, 5])
@pytest.mark.parametrize('dtype', [MARKER_DTYPE, MAP_DTYPE])
def test_rows_come_back(dtype, count):
    rows = rows_of(dtype, count)
    message = sent(clouds.cloud(rows, HEAD))
    assert message.point_step == dtype.itemsize
    assert [field.name for field in message.fields] == list(dtype.names)
    np.testing.assert_array_equal(clouds.cloud_rows(message, dtype), rows)


def other_layout(rows, order):
    """The same rows in doubles, in reverse order of fields, with gaps and a field of somebody else."""
    names = list(reversed(rows.dtype.names))
    layout = np.dtype(
        {
            'names': ['foreign', *names],
            'formats': [order + 'i2', *[order + ('u4' if rows.dtype[n].kind == 'u' else 'f8') for n in names]],
            'offsets': [1, *[4 + 9 * i for i in range(len(names))]],
            'itemsize': 12 + 9 * len(names),
        }
    )
    result = np.zeros(len(rows), layout)
    for name in names:
        result[name] = rows[name]
    types = {'i2': PointField.INT16, 'u4': PointField.UINT32, 'f8': PointField.FLOAT64}
    fields = [
        PointField(name=n, offset=layout.fields[n][1], datatype=types[layout.fields[n][0].str[1:]], count=1)
        for n in layout.names
    ]
    size = layout.itemsize
    return PointCloud2(
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=order == '>',
        point_step=size,
        row_step=size * len(rows),
        data=array('B', result.tobytes()),
    )


@pytest.mark.parametrize('order', ['<', '>'])
def test_fields_are_looked_up_by_name(order):
    rows = rows_of(MARKER_DTYPE, 4)
    np.testing.assert_array_equal(clouds.markers(other_layout(rows, order)), rows)


@pytest.mark.parametrize('order', ['<', '>', 'own'])
@pytest.mark.parametrize('frame', ['', 'a', 'camera'])
def test_markers_from_bytes_are_those_of_the_message(order, frame):
    rows = rows_of(MARKER_DTYPE, 4)
    message = clouds.cloud(rows, HEAD) if order == 'own' else other_layout(rows, order)
    message.header = convert.header(STAMP, frame)
    # What stands between the fields, each at a multiple of its size, is whatever the memory held.
    whole = bytes(serialize_message(message))
    assert (clouds.MARKER_CLOUDS.rows(whole) is not None) == (order == 'own')
    stamp, taken = clouds.stamped_markers(whole)
    assert stamp == STAMP
    np.testing.assert_array_equal(taken, rows)
    assert deserialize_message(clouds.MARKER_CLOUDS.message(rows, message.header), PointCloud2) == clouds.cloud(
        rows, message.header
    )


@pytest.mark.parametrize('field', ['height', 'width', 'row_step', 'point_step'])
def test_bytes_of_markers_whose_sizes_do_not_fit_are_refused(field):
    for size in (0, 1, 3, 2**16, 2**32 - 1):
        message = clouds.cloud(rows_of(MARKER_DTYPE, 2), HEAD)
        setattr(message, field, size)
        if size == getattr(clouds.cloud(rows_of(MARKER_DTYPE, 2), HEAD), field) or (field, size) == ('height', 0):
            continue
        with pytest.raises(InputError):
            clouds.stamped_markers(serialize_message(message))


def test_bytes_of_markers_that_are_cut_short_are_refused():
    whole = bytes(serialize_message(clouds.cloud(rows_of(MARKER_DTYPE, 2), HEAD)))
    for length in range(0, len(whole) - 4, 3):
        with pytest.raises(InputError):
            clouds.stamped_markers(whole[:length])


def test_corner_covariances_come_from_sigma_where_there_are_none():
    rows = rows_of(MARKER_DTYPE, 3)
    kept = [name for name in MARKER_DTYPE.names if name not in CORNER_COVARIANCE_FIELDS]
    short = np.dtype([(name, MARKER_DTYPE[name]) for name in kept])
    fewer = np.zeros(3, short)
    for name in kept:
        fewer[name] = rows[name]
    taken = clouds.markers(clouds.cloud(fewer, HEAD))
    for corner in range(4):
        np.testing.assert_array_equal(taken[f'c{corner}uu'], rows['sigma_px'] ** 2)
        np.testing.assert_array_equal(taken[f'c{corner}uv'], 0.0)


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'fields': []}, 'without field'),
        ({'width': 9}, 'bytes'),
        ({'row_step': 8}, 'bytes'),
        ({'point_step': 20, 'row_step': 40}, 'outside'),
        ({'data': array('B')}, 'bytes'),
    ],
)
def test_a_cloud_whose_sizes_do_not_fit_is_refused(changes, reason):
    message = clouds.cloud(rows_of(MARKER_DTYPE, 2), HEAD)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=reason):
        clouds.markers(message)


@pytest.mark.parametrize('offset', [MARKER_DTYPE.itemsize - 3, 2**31 - 2, 2**31 + 8, 2**32 - 4])
def test_a_field_outside_its_points_is_refused(offset):
    # With offsets near 2^31 numpy's own check overflows, and reading them ended the process.
    message = sent(clouds.cloud(rows_of(MARKER_DTYPE, 2), HEAD))
    message.fields[3].offset = offset
    with pytest.raises(InputError, match='outside its points'):
        clouds.markers(message)


@pytest.mark.parametrize('name', ['u2', 'detector_px'])
def test_corners_that_are_not_finite_are_refused(name):
    rows = rows_of(MARKER_DTYPE, 2)
    rows[name][1] = np.nan
    with pytest.raises(InputError, match='not finite'):
        clouds.markers(clouds.cloud(rows, HEAD))


def test_the_map_for_the_detector_says_which_markers_are_in_quarantine():
    rows = np.zeros(2, MAP_DTYPE)
    rows['id'], rows['trusted'], rows['size'], rows['qw'], rows['x'] = [4, 5], [1, 0], 0.3, 1.0, [2.0, 3.0]
    poses, quarantined = clouds.map_poses(sent(clouds.cloud(rows, HEAD)))
    assert (list(poses), quarantined) == ([4, 5], {5})
    T, size = poses[4]
    np.testing.assert_array_equal(T, transform(np.eye(3), [2.0, 0.0, 0.0]))
    assert size == np.float32(0.3)


# --- estimates ----------------------------------------------------------------------------------------


def random_pose(rng):
    return transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def test_poses_and_odometry_come_back():
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(2, 6, 6))
    odometry = Odometry(STAMP, random_pose(rng), rng.normal(size=3), rng.normal(size=3), A @ A.T, B @ B.T)
    (taken,) = message_bytes.odometry([serialize_message(messages.odometry(odometry))])
    pose = message_bytes.camera_pose(
        serialize_message(messages.pose_with_covariance(odometry.T_map_body, A @ A.T, HEAD))
    )
    # A quaternion in between: the last digits of the rotation may differ.
    np.testing.assert_allclose(taken.T_map_body, odometry.T_map_body, atol=1e-15)
    np.testing.assert_allclose(pose.T_map_camera, odometry.T_map_body, atol=1e-15)
    np.testing.assert_array_equal(pose.covariance, A @ A.T)
    for name in ('stamp_ns', 'velocity_body', 'angular_velocity_body', 'pose_covariance', 'twist_covariance'):
        np.testing.assert_array_equal(getattr(taken, name), getattr(odometry, name))


@pytest.mark.parametrize(
    'pose',
    [
        Pose(orientation=Quaternion(w=0.0)),
        Pose(orientation=Quaternion(w=float('nan'))),
        Pose(orientation=Quaternion(w=2.0)),
    ],
)
def test_an_invalid_pose_is_refused(pose):
    message = PoseWithCovarianceStamped()
    message.pose.pose = pose
    with pytest.raises(InputError, match='unit quaternion'):
        message_bytes.camera_pose(serialize_message(message))


def test_a_covariance_that_is_not_finite_is_refused():
    message = messages.pose_with_covariance(np.eye(4), np.full((6, 6), np.inf), HEAD)
    with pytest.raises(InputError, match='covariance'):
        message_bytes.camera_pose(serialize_message(message))


def test_an_imu_message():
    message = Imu(header=HEAD, angular_velocity=convert.vector(np.array([1.0, 2.0, 3.0])))
    message.linear_acceleration = convert.vector(np.array([4.0, 5.0, 6.0]))
    sample = convert.imu_sample(sent(message))
    assert sample.stamp_ns == STAMP
    assert sample.angular_velocity.tolist() == [1.0, 2.0, 3.0]
    assert sample.linear_acceleration.tolist() == [4.0, 5.0, 6.0]


@pytest.mark.parametrize('value', [float('nan'), float('inf')])
@pytest.mark.parametrize('name', ['angular_velocity', 'linear_acceleration'])
def test_an_imu_message_that_is_not_finite_is_refused(name, value):
    message = Imu(header=HEAD)
    getattr(message, name).y = value
    with pytest.raises(InputError, match='not finite'):
        convert.imu_sample(message)


def test_an_imu_message_without_accelerations_is_refused():
    message = Imu(header=HEAD)
    message.linear_acceleration_covariance[0] = -1.0
    with pytest.raises(InputError, match='without'):
        convert.imu_sample(message)


def test_diagnostics():
    (status,) = sent(convert.diagnostics('node', b'\x01', 'why', {'a': 1.5, 'b': 'x'}, STAMP)).status
    assert (status.name, status.level, status.message) == ('node', b'\x01', 'why')
    assert [(item.key, item.value) for item in status.values] == [('a', '1.5'), ('b', 'x')]
