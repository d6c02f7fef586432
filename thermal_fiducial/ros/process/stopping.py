"""Signals that stop a node: the first one requests the stop, and none interrupts a save."""

from collections.abc import Callable
import os
import signal
from threading import Thread
from types import FrameType

#: Signals that stop a node; SIGHUP comes from a closed terminal.
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Timeouts of leaving the graph after all is saved: processor time [s], of which it takes 0.1 to 0.2, and wall time
#: [s], of which it took 8 under tenfold overload.
LEAVING_CPU_S, LEAVING_S = 2.0, 20.0
#: Wall time of that for a node that crashed or is deaf [s]: the sooner it is restarted, the better.
CRASHED_S = 5.0


class StopSignals:
    """Handles SIGINT, SIGTERM and SIGHUP as one stop request, from now to the end of the process.

    Python's default, KeyboardInterrupt, is raised anywhere in the main thread: a second signal (``ros2 launch``
    forwards what the terminal has sent already) would interrupt a save. So none is raised. Python's handlers run in
    the main thread, which may be waiting for messages in C, so another thread wakes it.

    Parameters
    ----------
    wake : makes the main thread return to Python; called in another thread, once a signal
    """

    def __init__(self, wake: Callable[[], object]) -> None:
        self._wake = wake
        #: whether a signal has come
        self.asked = False
        self._reading, writing = os.pipe()
        os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        for number in STOPS:
            # nohup has set SIGHUP to be ignored.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._on_signal)
        Thread(target=self._watch, daemon=True).start()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

    def _watch(self) -> None:
        while number := os.read(self._reading, 1):
            if number[0] in STOPS:
                self.asked = True
                self._wake()

    def ignore(self) -> None:
        """Ignore further signals: in its finalisation the interpreter would restore the default handlers."""
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN)


def limit_the_end(crashed: type[BaseException] | None = None, *_: object) -> None:
    """Arm SIGPROF and SIGALRM to end a process that hangs at its end; call it once all is saved.

    SIGPROF is for a process that was stopped, not for one that ``crashed``: launch files distinguish them by it.

    Fast DDS 2 waits for a discovery callback in a loop that almost always holds the lock which that callback needs:
    minutes on a busy machine. It holds the GIL meanwhile, so that no Python thread could end it.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    if crashed is not None:
        signal.setitimer(signal.ITIMER_REAL, CRASHED_S)
        return
    signal.setitimer(signal.ITIMER_REAL, LEAVING_S)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, LEAVING_CPU_S)


def release_the_end() -> None:
    """Disarm :func:`limit_the_end`, whose timers a program that replaces this one would inherit."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.setitimer(signal.ITIMER_PROF, 0.0)
