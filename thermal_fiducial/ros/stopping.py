"""Signals that end a node: the first one stops it, and none interrupts what it still has to save."""

from collections.abc import Callable
import os
import signal
from threading import Thread
from types import FrameType

#: A terminal that is closed ends a node like the others do, with all that it has to save.
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: What a node that has saved what it must may take to leave the graph: processor time [s], of which it takes 0.1 to
#: 0.2, and time [s], of which it took 8 on a machine with ten times as much to do as it can.
LEAVING_CPU_S, LEAVING_S = 2.0, 20.0


class StopSignals:
    """Takes SIGINT, SIGTERM and SIGHUP for one request to stop, from now to the end of the process.

    Python's own answer, KeyboardInterrupt, comes out of whatever the main thread is doing: a second one (``ros2
    launch`` forwards what the terminal has sent already) out of the middle of a save. So none is raised at all. And
    since Python's handlers wait for the main thread, which waits for messages in C, a thread of its own wakes it.

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
            # Under nohup a closed terminal is to be ignored.
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
        """Let no further signal end the process: the interpreter, while it ends, would take it for the default one."""
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN)


def limit_the_end() -> None:
    """End the process by SIGPROF or SIGALRM when it does not end by itself; when nothing is left to be saved.

    Fast DDS 2 waits for a callback of the discovery to end, in a loop that holds nearly all the time the lock which the
    callback needs: minutes on a busy machine, with Python's interpreter locked. So no thread of Python could end it.
    """
    for number, timer, seconds in (
        (signal.SIGPROF, signal.ITIMER_PROF, LEAVING_CPU_S),
        (signal.SIGALRM, signal.ITIMER_REAL, LEAVING_S),
    ):
        signal.signal(number, signal.SIG_DFL)
        signal.setitimer(timer, seconds)
