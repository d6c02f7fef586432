"""A filter that crashed in flight goes on with what it knew last."""

import json
import os
import time

import numpy as np
import pytest
from support import small_bag
from support.messages import imu, pose
from support.ros_graph import ros_graph

from thermal_fiducial.core.filter.initialization import LastPose
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.last_pose import recent_pose, save_last_pose
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode

SECOND = 1_000_000_000
LAST = LastPose(5 * SECOND, transform(so3_exp([0.0, 0.0, 0.3]), [1.0, 2.0, 3.0]), 0.004)


def test_the_file_holds_it_for_ten_seconds(tmp_path):
    path = tmp_path / 'folder' / 'pose_ekf.json'
    save_last_pose(path, LAST)
    found = recent_pose(path)
    np.testing.assert_array_equal(found.T_map_body, LAST.T_map_body)
    assert (found.stamp_ns, found.camera_time_offset) == (LAST.stamp_ns, 0.004)
    os.utime(path, (0, time.time() - 11.0))
    assert recent_pose(path) is None


@pytest.mark.parametrize(
    'text',
    [
        '', '{', '[]', '1', '{"stamp_ns": 1}', '[' * 9000, '{"a": ' * 1500, '\xff', ' ' * 1_000_000,
        '{"stamp_ns": 1, "T_map_body": [[1.0]], "camera_time_offset": null}',
    ],
)  # fmt: skip
def test_an_unusable_file_of_the_last_pose_is_ignored(tmp_path, text):
    (tmp_path / 'pose.json').write_text(text, encoding='latin-1')
    assert recent_pose(tmp_path / 'pose.json') is None


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('stamp_ns', '1e999'), ('stamp_ns', '1' + '0' * 30), ('stamp_ns', '-1'), ('stamp_ns', '"x"'), ('format', '"x"'),
        ('T_map_body', 'NaN'), ('T_map_body', '[1e200]'), ('camera_time_offset', 'NaN'), ('camera_time_offset', '7'),
        ('version', '[]'),
    ],
)  # fmt: skip
def test_values_that_no_filter_leaves_are_no_hint(tmp_path, field, value):
    path = tmp_path / 'pose.json'
    save_last_pose(path, LAST)
    document = json.loads(path.read_text())
    text = json.dumps({**document, field: 'HERE'}).replace('"HERE"', value)
    path.write_text(text.replace('1e200', json.dumps([[1e200] * 4] * 4)[1:-1]))
    assert recent_pose(path) is None


def test_what_stands_where_the_file_is_made_is_neither_followed_nor_waited_for(tmp_path):
    path, victim = tmp_path / 'pose.json', tmp_path / 'victim'
    victim.write_text('precious')
    (tmp_path / 'pose.json.new').symlink_to(victim)
    with pytest.raises(InputError, match='pose'):
        save_last_pose(path, LAST)
    assert victim.read_text() == 'precious'
    (tmp_path / 'pose.json.new').unlink()
    os.mkfifo(tmp_path / 'pose.json.new')
    with pytest.raises(InputError, match='pose'):
        save_last_pose(path, LAST)
    os.mkfifo(path)
    assert recent_pose(path) is None


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='file'):
        save_last_pose(tmp_path / 'file' / 'pose.json', LAST)


def fly(graph, first, last, T=None):
    for k in range(first, last):
        graph.send('imu/data', imu(k))
        if k % 6 == 5:
            graph.send('camera_pose', pose(k - 4, T))


@pytest.mark.ros
@pytest.mark.parametrize('closed', [False, True])
def test_a_restarted_filter_logs_it_and_refuses_impossible_poses(tmp_path, monkeypatch, capfd, closed):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    far = transform(np.eye(3), [20.0, 0.0, 0.0]) @ small_bag.T_BODY_CAMERA
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, live=True, camera_position=[0.1, 0.0, 0.0])
        fly(graph, 0, 60)
        node.diagnose(0)
        # It is killed, or it has crashed or is deaf and closes what it has: in any case the flight goes on.
        if closed:
            node.close()
    with ros_graph() as graph:
        again = graph.add(PoseEkfNode, live=True, camera_position=[0.1, 0.0, 0.0])
        fly(graph, 100, 130, far)
        assert again.filter.state is None
        assert 'from the last pose before the restart' in again.state()[1]
        fly(graph, 130, 160)
        assert again.filter.state is not None
        again.finish()
        again.close()
    assert 'started again in flight: the last pose before, at ' in capfd.readouterr().err
    with ros_graph() as graph:
        graph.add(PoseEkfNode, live=True, camera_position=[0.1, 0.0, 0.0])
    assert 'started again' not in capfd.readouterr().err
