"""Recordings of CSV files become bags that replay takes."""

import os
import re

import cv2
import numpy as np
import pytest
from support import small_bag
from support.commands import status
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import inverse, transform
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC, TRUTH_TOPIC
from thermal_fiducial.files.images import image_to_array, stamp_to_ns

CAMERA = small_bag.CAMERA
T_BODY_CAMERA = transform(small_bag.T_BODY_CAMERA[:3, :3], [0.1, -0.02, 0.03])
FRAMES = small_bag.START_NS + 50_000_000 * np.arange(4)
NOISE = {'gyroscope_noise_density': 1e-3, 'accelerometer_noise_density': 2e-2}


def imu_csv(path, head='stamp_ns,wx,wy,wz,ax,ay,az'):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f'{small_bag.START_NS + k * 5_000_000},0.1,0.2,0.3,1,2,{9.8 + k}' for k in range(40)]
    path.write_text('\n'.join([head, *lines]) + '\n')


def rig(**camera):
    entry = {'width': CAMERA.width, 'height': CAMERA.height, 'model': 'radtan', 'K': CAMERA.K.ravel().tolist()}
    entry |= {'D': [-0.1, 0.01, 0.0, 0.0], 'T_body_camera': T_BODY_CAMERA.ravel().tolist()}
    return {'cameras': {'cam1': entry | camera}, 'imu': NOISE, 'marker_size': 0.3, 'dictionary': 'DICT_4X4_50'}


@pytest.fixture
def ours(tmp_path):
    """A folder of our layout with corners of two markers in each frame."""
    folder = tmp_path / 'ours'
    imu_csv(folder / 'imu.csv')
    (folder / 'rig.yaml').write_text(yaml.safe_dump(rig()))
    lines = ['stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3']
    for stamp in FRAMES:
        lines += [f'{stamp},{key},{10 * key},20,{10 * key + 50},20,{10 * key + 50},70,{10 * key},70' for key in (7, 3)]
    (folder / 'cam1.csv').write_text('\n'.join(lines) + '\n')
    (folder / 'reference.tum').write_text('1700000000.0 1 2 3 0 0 0 1\n1700000000.1 1 2 4 0 0 0 1\n')
    return folder


def run(folder, *extra):
    """Exit status of the command, into ``bag`` beside the folder."""
    arguments = ['import', folder, '--out', folder.parent / 'bag', '--camera', 'cam1', *extra]
    return main([str(word) for word in arguments])


def contents(bag):
    """Topic to messages, with their bag stamps."""
    result = {}
    with BagReader(bag) as reader:
        for item in reader.messages():
            result.setdefault(item.topic, []).append((item.stamp_ns, item.message))
    return result


def parameters(bag):
    return yaml.safe_load((bag / 'params.yaml').read_text())['/**']['ros__parameters']


def test_corners_become_markers(ours, capsys):
    assert run(ours, '--sigma-px', '0.4', '--late', '0.02') == 0
    assert '40 IMU samples, 4 frames' in capsys.readouterr().out
    found = contents(ours.parent / 'bag')
    assert {topic: len(messages) for topic, messages in found.items()} == {
        IMU_TOPIC: 40, CAMERA_INFO_TOPIC: 4, 'markers': 4, TRUTH_TOPIC: 2,
    }  # fmt: skip
    arrival, message = found['markers'][1]
    assert arrival == FRAMES[1] + 20_000_000
    assert stamp_to_ns(message.header.stamp) == FRAMES[1]
    rows = np.frombuffer(message.data.tobytes(), MARKER_DTYPE)
    assert rows['id'].tolist() == [3, 7]
    assert rows['u1'].tolist() == [80.0, 120.0]
    np.testing.assert_allclose(rows['sigma_px'], 0.4, rtol=1e-6)
    np.testing.assert_allclose(rows['c2vv'], 0.16, rtol=1e-6)
    # A square of 50 px seen straight on at 745 px of focal length.
    np.testing.assert_allclose(rows['z'], 0.3 * 745.0 / 50.0, rtol=0.05)
    sample = found[IMU_TOPIC][3][1]
    assert (sample.angular_velocity.y, sample.linear_acceleration.z) == (0.2, 12.8)
    assert found[CAMERA_INFO_TOPIC][0][1].distortion_model == 'plumb_bob'


def test_the_rig_becomes_parameters(ours):
    assert run(ours) == 0
    values = parameters(ours.parent / 'bag')
    assert (values['marker_size'], values['dictionary'], values['imu']) == (0.3, 'DICT_4X4_50', NOISE)
    np.testing.assert_allclose(values['camera_position'], [0.1, -0.02, 0.03])
    np.testing.assert_allclose(values['camera_orientation'], [-0.5, 0.5, -0.5, 0.5], atol=1e-12)


def test_camera_poses_with_their_covariance(ours):
    (ours / 'cam1.csv').unlink()
    A = np.random.default_rng(0).normal(size=(6, 6))
    covariance = (A @ A.T).ravel()
    words = ','.join(map(str, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, *covariance]))
    (ours / 'camera_pose.csv').write_text(f'{FRAMES[0]},{words}\n')
    assert run(ours) == 0
    ((_, message),) = contents(ours.parent / 'bag')['camera_pose']
    assert message.pose.pose.position.z == 3.0
    np.testing.assert_array_equal(message.pose.covariance, covariance)


@pytest.mark.parametrize('comment', ['', '# '])
def test_quaternions_whose_header_has_w_first_are_refused(ours, capsys, comment):
    """They were taken for x y z w; numpy writes a header as a comment."""
    (ours / 'camera_pose.csv').write_text(f'{comment}stamp_ns,x,y,z,qw,qx,qy,qz\n{FRAMES[0]},1,2,3,1,0,0,0\n')
    assert run(ours) == 2
    said = capsys.readouterr().err
    assert 'camera_pose.csv line 1: column 5 is qw; they are stamp_ns, x, y, z, qx, qy, qz, qw' in said


def test_frames_may_come_before_the_clock_of_the_imu_begins(ours):
    """Both clocks begin at 0, that of the camera 20 ms early."""
    for name in ('imu.csv', 'cam1.csv'):
        text = (ours / name).read_text()
        (ours / name).write_text(
            re.sub(r'^\d+', lambda stamp: str(int(stamp[0]) - small_bag.START_NS), text, flags=re.M)
        )
    (ours / 'reference.tum').unlink()
    (ours / 'rig.yaml').write_text(yaml.safe_dump(rig(time_offset=-0.02)))
    assert run(ours) == 0
    found = contents(ours.parent / 'bag')
    assert [(at, stamp_to_ns(message.header.stamp)) for at, message in found['markers'][:2]] == [
        (0, 0), (30_000_000, 50_000_000),
    ]  # fmt: skip


@pytest.mark.parametrize('change', [lambda stamp: stamp // 1000, lambda stamp: stamp + 10**10])
def test_frames_of_another_time_than_the_imu_are_refused(ours, capsys, change):
    """In microseconds, say: the bag lasted 54 years, and its replay had no pose and no reason."""
    corrupt(ours / 'cam1.csv', lambda text: re.sub(r'^\d+', lambda stamp: str(change(int(stamp[0]))), text, flags=re.M))
    assert run(ours) == 2
    assert 's apart: are all stamps nanoseconds of one clock?' in capsys.readouterr().err
    assert not (ours.parent / 'bag').exists()


def test_stamps_that_go_back_stay_in_the_bag(ours):
    lines = (ours / 'imu.csv').read_text().splitlines()
    lines[10], lines[11] = lines[11], lines[10]
    (ours / 'imu.csv').write_text('\n'.join(lines))
    assert run(ours) == 0
    stamps = [stamp_to_ns(message.header.stamp) for _, message in contents(ours.parent / 'bag')[IMU_TOPIC]]
    assert len(stamps) == 40
    assert stamps[9] > stamps[10]


PICTURE = np.arange(512 * 640, dtype=np.uint16).reshape(512, 640)


@pytest.fixture
def euroc(tmp_path):
    """A folder of EuRoC's layout."""
    place = tmp_path / 'flight' / 'mav0'
    imu_csv(place / 'imu0' / 'data.csv', '#timestamp [ns],w_RS_S_x [rad s^-1],...')
    T_body_imu = transform(np.eye(3), [0.5, 0.0, 0.0])
    sensor = {'T_BS': {'rows': 4, 'cols': 4, 'data': T_body_imu.ravel().tolist()}, **NOISE}
    (place / 'imu0' / 'sensor.yaml').write_text(yaml.safe_dump(sensor))
    (place / 'cam1' / 'data').mkdir(parents=True)
    camera = {'T_BS': {'data': (T_body_imu @ T_BODY_CAMERA).ravel().tolist()}, 'resolution': [640, 512]}
    camera |= {'intrinsics': [745.0, 746.0, 319.5, 255.5], 'distortion_model': 'radial-tangential'}
    camera |= {'distortion_coefficients': [-0.28, 0.07, 0.0, 0.0]}
    (place / 'cam1' / 'sensor.yaml').write_text('%YAML:1.0\n---\n' + yaml.safe_dump(camera))
    names = [f'{stamp},{stamp}.png' for stamp in FRAMES]
    (place / 'cam1' / 'data.csv').write_text('#timestamp [ns],filename\n' + '\n'.join(names))
    for stamp in FRAMES:
        cv2.imwrite(str(place / 'cam1' / 'data' / f'{stamp}.png'), PICTURE)
    (place / 'state_groundtruth_estimate0').mkdir()
    (place / 'state_groundtruth_estimate0' / 'data.csv').write_text(f'#t\n{FRAMES[0]},1,2,3,0.5,0.5,-0.5,0.5,0,0,0\n')
    return tmp_path / 'flight'


def test_euroc(tmp_path, euroc):
    assert run(euroc) == 0
    found = contents(tmp_path / 'bag')
    np.testing.assert_array_equal(image_to_array(found[IMAGE_TOPIC][2][1]), PICTURE)
    assert found[CAMERA_INFO_TOPIC][0][1].k[4] == 746.0
    orientation = found[TRUTH_TOPIC][0][1].pose.pose.orientation
    assert (orientation.w, orientation.x, orientation.y, orientation.z) == (0.5, 0.5, -0.5, 0.5)
    # The IMU is half a metre beside the body, along its x axis.
    place = found[TRUTH_TOPIC][0][1].pose.pose.position
    np.testing.assert_allclose([place.x, place.y, place.z], [1.0, 2.0, 3.5], atol=1e-12)
    # The pose of the camera in the frame of the IMU, wherever the body's is.
    np.testing.assert_allclose(parameters(tmp_path / 'bag')['camera_position'], [0.1, -0.02, 0.03], atol=1e-12)


def test_a_ground_truth_without_attitude_is_refused(euroc, capsys):
    corrupt(euroc / 'mav0' / 'state_groundtruth_estimate0' / 'data.csv', lambda text: re.sub('-?0.5', '0', text))
    assert run(euroc) == 2
    assert 'data.csv line 2: numbers, but none that were measured' in capsys.readouterr().err


def test_kalibr(tmp_path, capsys):
    folder = tmp_path / 'flight'
    imu_csv(folder / 'imu0.csv', 'timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z')
    (folder / 'cam1').mkdir()
    for stamp in FRAMES:
        cv2.imwrite(str(folder / 'cam1' / f'{stamp}.png'), (PICTURE >> 8).astype(np.uint8))
    chain = {'camera_model': 'pinhole', 'intrinsics': [745.0, 746.0, 319.5, 255.5], 'resolution': [640, 512]}
    chain |= {'distortion_model': 'equidistant', 'distortion_coeffs': [0.01, -0.02, 0.03, -0.01]}
    chain |= {'T_cam_imu': inverse(T_BODY_CAMERA).tolist(), 'timeshift_cam_imu': -0.012}
    (folder / 'camchain-imucam.yaml').write_text(yaml.safe_dump({'cam1': chain}))
    (folder / 'imu.yaml').write_text(yaml.safe_dump({**NOISE, 'update_rate': 200.0}))
    assert run(folder, '--late', '0.03') == 0
    values = parameters(tmp_path / 'bag')
    assert (values['camera_time_offset'], values['imu']) == (-0.012, NOISE)
    np.testing.assert_allclose(values['camera_position'], [0.1, -0.02, 0.03], atol=1e-12)
    found = contents(tmp_path / 'bag')
    assert found[IMAGE_TOPIC][0][0] == FRAMES[0] + 18_000_000
    assert found[CAMERA_INFO_TOPIC][0][1].distortion_model == 'equidistant'
    np.testing.assert_array_equal(image_to_array(found[IMAGE_TOPIC][0][1]), (PICTURE >> 8).astype(np.uint8))
    # Kalibr leaves a copy of the IMU file; others may have "imu" in their names. Of two that differ neither is taken.
    (folder / 'a-imu.yaml').write_text(yaml.safe_dump({'imu0': NOISE | {'update_rate': 200.0}}))
    (folder / 'a-imu-filter.yaml').write_text(yaml.safe_dump({'window': 5}))
    assert run(folder, '--out', tmp_path / 'twice') == 0
    assert parameters(tmp_path / 'twice') == values
    (folder / 'b-imu.yaml').write_text(yaml.safe_dump(NOISE | {'gyroscope_noise_density': 2e-3}))
    assert run(folder, '--out', tmp_path / 'two') == 2
    assert 'a-imu.yaml, b-imu.yaml, imu.yaml: different noise densities: name one' in capsys.readouterr().err
    (folder / 'b-imu.yaml').unlink()
    # Kalibr leaves that of the cameras alone beside it, whose name comes first. Of two calibrations neither is taken.
    (folder / 'camchain-flight.yaml').write_text(yaml.safe_dump({'cam1': {}}))
    assert run(folder, '--out', tmp_path / 'beside') == 0
    assert parameters(tmp_path / 'beside') == values
    (folder / 'camchain-imucam-2.yaml').write_text(yaml.safe_dump({'cam1': chain | {'timeshift_cam_imu': 0.5}}))
    assert run(folder, '--out', tmp_path / 'either') == 2
    assert 'camchain-imucam-2.yaml, camchain-imucam.yaml: name one with --camchain' in capsys.readouterr().err
    # Beside a newer one from elsewhere the camchain of the folder is no file of the IMU.
    (tmp_path / 'newer.yaml').write_text(yaml.safe_dump({'cam1': chain | {'timeshift_cam_imu': 0.001}}))
    assert run(folder, '--camchain', tmp_path / 'newer.yaml', '--out', tmp_path / 'again') == 0
    values = parameters(tmp_path / 'again')
    assert (values['camera_time_offset'], values['imu']) == (0.001, NOISE)


def corrupt(path, change):
    path.write_text(change(path.read_text()))


@pytest.mark.parametrize(
    ('name', 'change', 'words'),
    [
        ('imu.csv', lambda text: text.replace(',0.3,', ',x,', 1), ('imu.csv line 2', 'not numbers')),
        ('imu.csv', lambda text: text.replace(',0.3,', ',nan,', 1), ('imu.csv line 2', 'not finite')),
        ('imu.csv', lambda text: text + '17,1,2\n', ('imu.csv line 42', '3 values')),
        ('imu.csv', lambda text: '', ('imu.csv', 'no lines')),
        ('cam1.csv', lambda text: text.replace('1700000000000000000', '17e3', 1), ('cam1.csv line 2', 'stamp')),
        ('rig.yaml', lambda text: '- 1', ('rig.yaml',)),
        ('rig.yaml', lambda text: text.replace('cam1', 'cam0'), ('rig.yaml', 'cam1', 'cam0')),
        ('rig.yaml', lambda text: text.replace('width: 640', 'width: wide'), ('rig.yaml: line', 'cam1: width', 'wide')),
        ('rig.yaml', lambda text: text.replace('radtan', 'cubic'), ('rig.yaml', 'cubic')),
        ('rig.yaml', lambda text: text.replace('D:', 'distortion_coefficients:'), ('rig.yaml', 'model without D')),
        ('rig.yaml', lambda text: text.replace('marker_size: 0.3', ''), ('--marker-size',)),
        ('rig.yaml', lambda text: text.replace('DICT_4X4_50', '/dev/zero'), ('/dev/zero', 'dictionary')),
        ('imu.csv', lambda text: text.replace('1700000000', '9000000000'), ('imu.csv line 2', 'stamp')),
        ('imu.csv', lambda text: text.replace('000000,0.1', ',0.1'), ('imu.csv', '5e-09 s apart', 'nanoseconds')),
        ('imu.csv', lambda text: re.sub('1,2,.*', '0.1,0.2,1', text), ('imu.csv', 'in g')),
        ('imu.csv', lambda text: text.replace(',0.3,', ',40,'), ('imu.csv', 'degrees')),
        ('imu.csv', lambda text: text.replace('wx,wy,wz', 'wz,wy,wx'), ('imu.csv line 1', 'column 2 is wz')),
        ('cam1.csv', lambda text: text.replace('u1,v1', 'v1,u1'), ('cam1.csv line 1', 'column 5 is v1')),
        ('cam1.csv', lambda text: text.replace(',20,', ',1e30,', 1), ('cam1.csv line 2', 'measured')),
        ('cam1.csv', lambda text: re.sub('(?m)$', ',0', text), ('cam1.csv line 2', 'measured')),
    ],
)
def test_what_is_broken_is_named(ours, capsys, name, change, words):
    corrupt(ours / name, change)
    assert run(ours) == 2
    (line,) = capsys.readouterr().err.splitlines()
    for word in words:
        assert word in line


def test_an_unreadable_picture_leaves_no_incomplete_bag(tmp_path, capsys):
    folder = tmp_path / 'flight'
    imu_csv(folder / 'imu0.csv')
    (folder / 'cam1').mkdir()
    (folder / 'cam1' / f'{FRAMES[0]}.png').write_bytes(b'none')
    chain = {'intrinsics': [745.0, 746.0, 319.5, 255.5], 'resolution': [640, 512], 'T_cam_imu': np.eye(4).tolist()}
    (folder / 'camchain.yaml').write_text(yaml.safe_dump({'cam1': chain}))
    assert run(folder) == 2
    assert f'{FRAMES[0]}.png' in capsys.readouterr().err
    assert not (tmp_path / 'bag').exists()


def test_a_folder_of_no_known_layout(tmp_path, capsys):
    (tmp_path / 'empty').mkdir()
    assert run(tmp_path / 'empty') == 2
    assert 'no imu.csv' in capsys.readouterr().err
    assert run(tmp_path / 'nothing') == 2


def test_an_invalid_transform_is_refused(ours, capsys):
    (ours / 'rig.yaml').write_text(yaml.safe_dump(rig(T_body_camera=[1.0] * 16)))
    assert run(ours) == 2
    assert 'no rigid transform' in capsys.readouterr().err


def test_noise_densities_that_the_nodes_refuse_are_refused(ours, capsys):
    (ours / 'rig.yaml').write_text(yaml.safe_dump(rig() | {'imu': {'gyroscope_noise_density': 4.0}}))
    assert run(ours) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'gyroscope_noise_density' in line
    assert '0.1' in line
    assert not (ours.parent / 'bag').exists()


@pytest.mark.parametrize('variance', [0.0, -1.0, 1e300])
def test_poses_without_a_covariance_are_refused(ours, capsys, variance):
    numbers = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *(variance * np.eye(6)).ravel()]
    (ours / 'camera_pose.csv').write_text(','.join(map(str, [FRAMES[0], *numbers])) + '\n')
    assert run(ours) == 2
    assert 'camera_pose.csv: pose with a covariance with a variance of' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['imu.csv', 'cam1.csv', 'camera_pose.csv', 'reference.tum'])
def test_what_is_no_file_is_not_taken_for_nothing(ours, capsys, name):
    (ours / name).unlink(missing_ok=True)
    os.mkfifo(ours / name)
    assert run(ours) == 2
    assert f'{name}: not a regular file' in capsys.readouterr().err


@pytest.mark.parametrize('options', [('--marker-size', 'nan'), ('--marker-size', '-1'), ('--camchain', 'chain.yaml')])
def test_options_that_cannot_be_used(ours, capsys, options):
    words = ['import', ours, '--out', ours.parent / 'bag', *options]
    assert status(words) == 2
    assert options[0] in capsys.readouterr().err


def test_an_error_of_corners_is_refused_where_all_have_their_own(ours, capsys):
    lines = (ours / 'cam1.csv').read_text().splitlines()
    with_sigma = [f'{line},{"0.2" if number else "sigma_px"}' for number, line in enumerate(lines)]
    (ours / 'cam1.csv').write_text('\n'.join(with_sigma) + '\n')
    assert run(ours, '--sigma-px', '0.3') == 2
    assert '--sigma-px has no effect with' in capsys.readouterr().err
    assert run(ours) == 0
