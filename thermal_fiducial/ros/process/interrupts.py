"""Ctrl-C of a command: where it may be raised, and what it must not break."""

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any, Self

#: Time after a KeyboardInterrupt in which no other one is raised [s]: closing bags, nodes and workers takes up to one,
#: and whoever presses Ctrl-C twice does so within it.
PAUSE_S = 2.0


class Interrupts:
    """Handles SIGINT while it lasts; a context manager.

    Python's default, KeyboardInterrupt, is raised anywhere. Inside a conversion of rclpy it becomes a TypeError, inside
    a node's callback an internal error of the node; a second one ends the clearing up that the first one has begun.

    In threads other than the main one, and where a shell has set SIGINT to be ignored, it does nothing.

    Parameters
    ----------
    held : raise only from :meth:`check` and at the end; else anywhere, but not again within :data:`PAUSE_S`
    """

    def __init__(self, *, held: bool) -> None:
        self._held = held
        self._raised_s = -PAUSE_S
        self._before: Any = None
        #: whether Ctrl-C has been pressed
        self.asked = False

    def __enter__(self) -> Self:
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGINT) not in (signal.SIG_IGN, None):
            self._before = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        now = time.monotonic()
        if not self._held and now - self._raised_s > PAUSE_S:
            self._raised_s = now
            raise KeyboardInterrupt

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C has been pressed."""
        if self.asked:
            raise KeyboardInterrupt

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
        if self._held and kind is not KeyboardInterrupt:
            # Errors are consequences of it, such as that of a node that has had it too.
            self.check()
