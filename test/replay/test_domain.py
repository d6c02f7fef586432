"""The DDS domain of a replay."""

import subprocess
import sys

import pytest
from rclpy.context import Context
from rclpy.node import Node
from support.empty_stage import environment

from thermal_fiducial.replay.domain import own_domain


def test_a_replay_is_not_in_the_domain_of_the_user(monkeypatch):
    """Where a robot may be flying; other replays on the machine may take domains meanwhile, which changes nothing."""
    monkeypatch.delenv('ROS_DOMAIN_ID', raising=False)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with own_domain() as free:
        pass
    monkeypatch.setenv('ROS_DOMAIN_ID', str(free))
    with own_domain() as other:
        assert other != free


@pytest.mark.ros
def test_a_domain_in_which_any_program_of_the_machine_listens_is_left_to_it(monkeypatch):
    """A robot whose service has a domain of which the user's shell does not know could be given recorded IMU data."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    contexts = Context(), Context()
    with own_domain() as free:
        pass
    for context in contexts:
        context.init(domain_id=free)
    first, second = (Node('robot', context=context) for context in contexts)
    try:
        # The first one to come has the first ports; the second one stays in its own when that has gone.
        for node in (first, second):
            with own_domain() as other:
                assert other != free
            node.destroy_node()
        with own_domain() as again:
            assert again == free
    finally:
        for context in contexts:
            context.try_shutdown()


def test_replays_without_a_common_folder_for_temporary_files_are_in_two_domains(tmp_path):
    """As of two users, or of a service: in one domain each waited for ever for the messages of its own nodes alone."""
    program = 'from thermal_fiducial.replay.domain import own_domain\nwith own_domain() as domain: print(domain)'
    command = [sys.executable, '-c', program]
    with own_domain() as own:
        other = subprocess.run(command, env=environment() | {'TMPDIR': str(tmp_path)}, capture_output=True, check=True)
    assert int(other.stdout) != own
