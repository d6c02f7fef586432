"""Commands in processes of their own, interrupted as a terminal does it: the whole process group at once."""

import os
import signal
import subprocess
import sys
import time

from support.waiting import PATIENCE_S


def interrupted(words, begun, after_s, times, apart_s):
    """Exit status and lines of stderr of a command that is interrupted ``times`` times.

    Parameters
    ----------
    words : of the command line, from the command on
    begun : says of a process, by its ID, whether it is as far as the test wants it
    after_s : from there to the first interrupt [s]
    apart_s : between interrupts [s]
    """
    # A shell's background jobs ignore the signal, and so would what they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, '-m', 'thermal_fiducial', *map(str, words)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while process.poll() is None and not begun(process.pid):
        time.sleep(0.05)
    time.sleep(after_s)
    for _ in range(times):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(apart_s)
    # Workers that stay would hold the pipe.
    error = process.communicate(timeout=PATIENCE_S)[1]
    return process.returncode, error.splitlines()
