"""Waits of a replay: said, never ended."""

from thermal_fiducial.replay.waiting import PATIENCE_S, Wait


def test_a_wait_without_progress_is_reported_at_growing_intervals():
    now, said = [0.0], []
    wait = Wait(lambda: 'messages on pose', said.append, now=lambda: now[0])
    for _ in range(20):
        now[0] += PATIENCE_S / 2.0
        wait.go_on(7)
    # Ten times the patience: after one, two, four and eight of them.
    assert len(said) == 4
    assert said[0] == f'nothing for {PATIENCE_S:.0f} s, waiting for messages on pose'


def test_progress_begins_a_wait_anew():
    now, said = [0.0], []
    wait = Wait(lambda: 'messages', said.append, now=lambda: now[0])
    for progress in range(100):
        now[0] += 0.9 * PATIENCE_S
        wait.go_on(progress)
    assert said == []
