"""The DDS domain of a replay."""

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
