"""Work for a process of its own: it must be found by name over there."""

import os
import time


def work(task):
    """Process that works, and the answer."""
    if task == 'fail':
        raise ValueError('no answer')
    if task == 'die':
        os._exit(3)
    time.sleep(task)
    return os.getpid(), task
