"""The DDS domain of a replay."""

import subprocess
import sys

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


def test_replays_without_a_common_folder_for_temporary_files_are_in_two_domains(tmp_path):
    """As of two users, or of a service: in one domain each waited for ever for the messages of its own nodes alone."""
    program = 'from thermal_fiducial.replay.domain import own_domain\nwith own_domain() as domain: print(domain)'
    command = [sys.executable, '-c', program]
    with own_domain() as own:
        other = subprocess.run(command, env=environment() | {'TMPDIR': str(tmp_path)}, capture_output=True, check=True)
    assert int(other.stdout) != own
