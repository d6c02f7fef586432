"""How long tests wait, always for a condition: on a machine that is busy with others' work it is met late."""

import time

#: Longest wait for what takes seconds on an idle machine [s]; what is slower than that hangs. A test ends after 600.
PATIENCE_S = 300.0


def until(condition):
    """Wait until ``condition()`` holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        time.sleep(0.005)
        assert time.monotonic() < deadline, 'waited in vain'
