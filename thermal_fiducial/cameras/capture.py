"""A thread that reads a camera and reconnects after a loss."""

from collections.abc import Callable
import threading
import time

from thermal_fiducial.cameras.source import CapturedFrame, EndOfFramesError, FrameSource
from thermal_fiducial.errors import InputError, INTERNAL_ERROR

#: Interval of reconnection attempts; and timeout without frames after which a camera is reopened [s].
_RETRY_S, STALLED_S = 1.0, 3.0


class Capture:
    """Passes on the frames of a camera until it is closed.

    Parameters
    ----------
    source : the camera; only the thread touches it
    on_frame : called by the thread with each frame
    on_change : called by the thread with the state in words whenever that changes
    retry : pause before the next try to connect [s]
    stalled : silence that counts as a loss of the camera [s]
    """

    def __init__(
        self,
        source: FrameSource,
        on_frame: Callable[[CapturedFrame], None],
        on_change: Callable[[str], None],
        *,
        retry: float = _RETRY_S,
        stalled: float = STALLED_S,
    ) -> None:
        self._source = source
        self._on_frame = on_frame
        self._on_change = on_change
        self._retry, self._stalled = retry, stalled
        #: why there are no frames; empty while there are
        self.trouble = 'connecting'
        self._opened = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='camera', daemon=True)
        self._thread.start()

    @property
    def reconnections(self) -> int:
        """Number of reconnections."""
        return max(0, self._opened - 1)

    def close(self) -> None:
        """Stop reading and release the camera."""
        self._stop.set()
        # Each read returns within a fraction of a second; a driver that hangs in the kernel must not hold the node.
        self._thread.join(timeout=3.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._source.open()
                self._opened += 1
                self._stream()
            except EndOfFramesError:
                self._change('all pictures have been shown')
                self._stop.set()
            except InputError as error:
                self._change(str(error))
            except OSError as error:
                self._change(f'{self._source.name}: {error.strerror or error}')
            except Exception as error:  # whatever a library lets through must not end the flight
                self._change(f'{self._source.name}: {INTERNAL_ERROR}: {type(error).__name__}: {error}')
            finally:
                self._source.close()
            self._stop.wait(self._retry)

    def _stream(self) -> None:
        last = time.monotonic()
        while not self._stop.is_set():
            for frame in self._source.read():
                last = time.monotonic()
                self._change('')
                self._on_frame(frame)
            if time.monotonic() - last > self._stalled:
                raise OSError(f'no frame for {self._stalled:g} s')

    def _change(self, trouble: str) -> None:
        if trouble != self.trouble:
            self.trouble = trouble
            self._on_change(trouble)
