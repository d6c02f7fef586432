"""``check-bridge`` beside a running ``pose_ekf``: what leaves for a flight controller, checked as on a robot.

The drone stands still for some seconds, then flies and turns; data come in real time, stamped by this clock.
"""

import json
import os
import subprocess
import sys
import threading
import time

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import pytest
from rclpy.context import Context
from sensor_msgs.msg import Imu
from support.flights import CAMERA_ORIENTATION, CAMERA_POSITION, Flight, Motion, START_NS, timeline
from support.messages import pose_with_covariance
from support.waiting import PATIENCE_S

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.messages import convert

pytestmark = [pytest.mark.ros, pytest.mark.slow]

#: A busy machine may take a second or two until what leaves the filter reaches the listener.
STILL, SECONDS = 3.0, 6.5
#: Amplitude, frequency [rad/s], phase: 1 - cos, which starts at rest.
REST_THEN = np.array([[(1.0, 0.0, np.pi / 2), (1.0, 1.5, -np.pi / 2)]])


class FromRest(Motion):
    """Still at first."""

    def pose(self, t):
        return super().pose(np.maximum(np.asarray(t) - STILL, 0.0))

    def velocity(self, t):
        return np.where(np.asarray(t)[..., None] < STILL, 0.0, super().velocity(np.asarray(t) - STILL))

    def imu(self, t):
        moving = super().imu(np.asarray(t) - STILL)
        return np.where(np.asarray(t)[..., None] < STILL, Motion.still().imu(t), moving)


def flight():
    amplitudes = np.array([[0.4, 0.5, 0.2], [0.1, 0.1, 0.5]])[..., None, None] * [1.0, 0.0, 0.0] + [0.0, 1.0, 1.0]
    position, rotation = REST_THEN * amplitudes
    return Flight(seed=3, seconds=SECONDS, motion=FromRest(position, rotation))


def message(item, start_ns):
    frame = 'base_link' if isinstance(item, ImuSample) else 'map'
    head = convert.header(item.stamp_ns - START_NS + start_ns, frame)
    if not isinstance(item, ImuSample):
        return pose_with_covariance(item.T_map_camera, item.covariance, head)
    return Imu(
        header=head,
        angular_velocity=convert.vector(item.angular_velocity),
        linear_acceleration=convert.vector(item.linear_acceleration),
    )


def fly(data, domain, ready):
    """Publish the flight, each message when it is due."""
    context = Context()
    context.init(args=[], domain_id=domain)
    node = CountingNode('drone', context=context)
    outputs = {
        ImuSample: node.advertise(Imu, 'mavros/imu/data', qos.IMU_RATE_RESULT),
        None: node.advertise(PoseWithCovarianceStamped, 'camera_pose'),
    }
    # First the filter, then check-bridge too, so that none misses the seconds at rest.
    while not all(output.listeners for output in outputs.values()):
        time.sleep(0.02)
    ready.set()
    while outputs[ImuSample].listeners < 2:
        time.sleep(0.02)
    start_ns = time.time_ns()
    for item in timeline(data.samples(), data.poses, 0.03):
        late = 0 if isinstance(item, ImuSample) else 30_000_000
        wait = item.stamp_ns - START_NS + start_ns + late - time.time_ns()
        time.sleep(max(wait * 1e-9, 0.0))
        outputs[ImuSample if isinstance(item, ImuSample) else None].send(message(item, start_ns))
    node.destroy_node()
    context.try_shutdown()


@pytest.fixture
def flying(monkeypatch):
    """A filter in a process of its own that gets a flight."""
    with own_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        parameters = {
            'camera_position': list(CAMERA_POSITION),
            'camera_orientation': list(CAMERA_ORIENTATION),
            'bridge_rate': 40.0,
        }
        arguments = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
        # As mavros.launch.py has it.
        for name, other in (('bridge/odometry', 'mavros/odometry/out'), ('imu/data', 'mavros/imu/data')):
            arguments += ['-r', f'{name}:={other}']
        command = [sys.executable, '-m', 'thermal_fiducial.nodes.pose_ekf', '--ros-args', *arguments]
        node = subprocess.Popen(command, env=os.environ, stderr=subprocess.DEVNULL)
        ready = threading.Event()
        drone = threading.Thread(target=fly, args=(flight(), domain, ready), daemon=True)
        drone.start()
        try:
            assert ready.wait(PATIENCE_S)
            yield
            drone.join(PATIENCE_S)
            node.terminate()
            node.wait(PATIENCE_S)
        finally:
            node.kill()


def test_the_filter_as_a_flight_controller_sees_it(flying, capfd):
    status = main(['check-bridge', '--seconds', str(SECONDS + 0.5), '--json'])
    printed, said = capfd.readouterr()
    assert 'Listening to /mavros/odometry/out and /mavros/imu/data' in said
    findings = {finding['check']: finding for finding in json.loads(printed)}
    levels = {name: finding['level'] for name, finding in findings.items()}
    # a machine that tests keep busy may deliver late, which the report says; all else is the same on any
    assert 'not tested' not in {levels.pop(name) for name in ('rate', 'age', 'jumps')}
    # No mavros here.
    assert levels.pop('receivers') == 'warning'
    assert findings['receivers']['seen'] == '0 listen to /mavros/odometry/out'
    good = ('values', 'stamps', 'frame names', 'gravity', 'yaw', 'velocity', 'covariance')
    assert levels == dict.fromkeys(good, 'ok'), findings.get('filter')
    found = {finding['level'] for finding in findings.values()}
    assert status == (1 if 'fault' in found else 3 if 'not tested' in found else 0)
