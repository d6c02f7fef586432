"""Cameras that Linux shows as /dev/video*: Boson, PureThermal with a Lepton, and other USB cameras of 16-bit grey."""

from collections import Counter
import ctypes
from dataclasses import dataclass
import errno
from fractions import Fraction
from typing import Any

import numpy as np

from thermal_fiducial.cameras import v4l2_api as api
from thermal_fiducial.cameras.source import CapturedFrame
from thermal_fiducial.core.types import Counts, SECOND_NS
from thermal_fiducial.errors import InputError

#: Pixel formats of one 16-bit word per pixel; Y16 is requested, a driver may choose another one.
_Y16 = api.fourcc('Y16 ')
FORMATS = {
    _Y16: '<u2',
    _Y16 | 1 << 31: '>u2',
    api.fourcc('Y14 '): '<u2',
    api.fourcc('Y12 '): '<u2',
    api.fourcc('Y10 '): '<u2',
}
#: Buffers that the driver fills while one is read: an eighth of a second at 30 Hz.
_BUFFERS = 4
_PATIENCE_S = 0.2
#: Tolerance of the requested rate: 29.97 counts as 30.
_RATE_TOLERANCE = 0.02


@dataclass(frozen=True)
class _Layout:
    """Where the pixels are in a buffer."""

    #: height, width [px]
    shape: tuple[int, int]
    #: numpy's name of the type of a pixel
    kind: str
    #: from one row to the next [bytes]
    step: int

    @property
    def needed(self) -> int:
        """Size of a whole frame [bytes]; the last row may end with its last pixel."""
        height, width = self.shape
        return self.step * (height - 1) + 2 * width


class V4l2Camera:
    """A :class:`~thermal_fiducial.cameras.source.FrameSource`.

    Parameters
    ----------
    device : e.g. /dev/video0, or a link to it in /dev/v4l/by-id
    size : (width, height) to ask for; None: as the camera is set
    rate : frames a second to ask for [Hz]; 0: as the camera is set
    kernel : the system calls
    """

    def __init__(self, device: str, size: tuple[int, int] | None = None, rate: float = 0.0, kernel: Any = None) -> None:
        self.name = device
        self.events: Counter[str] = Counter()
        self._size = size
        self._rate = rate
        self._kernel: Any = kernel or api.Kernel()
        self._fd = -1
        self._maps: list[Any] = []
        self._layout = _Layout((0, 0), '<u2', 0)
        #: time from frame to frame [ns]; 0 where the driver does not know it
        self._period_ns = 0
        #: the driver's number of the next frame; None before the first
        self._next_sequence: int | None = None

    def open(self) -> None:
        """Choose format and rate, map buffers, start the stream; see the protocol."""
        self._fd = self._kernel.open(self.name)
        self._check_capability()
        self._layout = self._choose_format()
        self._period_ns = self._choose_rate()
        self._map_buffers()
        self._next_sequence = None
        self._call(api.STREAMON, ctypes.c_int32(api.CAPTURE))

    def read(self) -> list[CapturedFrame]:
        """Received frames; see the protocol."""
        frames: list[CapturedFrame] = []
        if not self._kernel.wait(self._fd, _PATIENCE_S):
            return frames
        while (buffer := self._take_buffer()) is not None:
            counts = self._accepted(buffer)
            if counts is not None:
                frames.append(CapturedFrame(self._stamp_ns(buffer), counts))
            self._call(api.QBUF, buffer)
        return frames

    def close(self) -> None:
        """Stop the stream and release the device."""
        fd, self._fd = self._fd, -1
        for buffer in self._maps:
            buffer.close()
        self._maps = []
        if fd >= 0:
            # Closing ends the stream too, even if the camera is gone.
            self._kernel.close(fd)

    def _call(self, request: int, argument: Any) -> Any:
        self._kernel.ioctl(self._fd, request, argument)
        return argument

    def _check_capability(self) -> None:
        try:
            capability = self._call(api.QUERYCAP, api.Capability())
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise InputError(f'{self.name} is no camera') from None
            raise
        able = capability.capabilities
        able = capability.device_caps if able & api.CAP_DEVICE_CAPS else able
        if not (able & api.CAP_VIDEO_CAPTURE and able & api.CAP_STREAMING):
            raise InputError(f'{self.name} streams no video (a UVC camera has a second device for its metadata)')

    def _choose_format(self) -> _Layout:
        wanted = self._call(api.G_FMT, api.Format(type=api.CAPTURE))
        wanted.pix.pixelformat, wanted.pix.field = _Y16, api.FIELD_NONE
        if self._size is not None:
            wanted.pix.width, wanted.pix.height = self._size
        wanted.pix.bytesperline = wanted.pix.sizeimage = 0
        pix = self._call(api.S_FMT, wanted).pix
        if pix.pixelformat not in FORMATS:
            raise InputError(f'{self.name} offers no 16-bit grey (Y16), but {api.fourcc_name(pix.pixelformat)}')
        if self._size is not None and (pix.width, pix.height) != self._size:
            asked = 'x'.join(map(str, self._size))
            raise InputError(f'{self.name} offers {pix.width}x{pix.height}, not {asked}')
        return _Layout((pix.height, pix.width), FORMATS[pix.pixelformat], pix.bytesperline or 2 * pix.width)

    def _choose_rate(self) -> int:
        """Set the requested rate, if any; the period [ns], 0 if the driver does not know it."""
        try:
            parameters = self._call(api.G_PARM, api.StreamParameters(type=api.CAPTURE))
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise
            parameters = api.StreamParameters()
        capture = parameters.capture
        if self._rate > 0.0:
            if not capture.capability & api.CAP_TIMEPERFRAME:
                raise InputError(f'{self.name} has one rate only: frame_rate must be 0')
            period = 1 / Fraction(self._rate).limit_denominator(1000)
            capture.timeperframe.numerator, capture.timeperframe.denominator = period.numerator, period.denominator
            capture = self._call(api.S_PARM, parameters).capture
        period = capture.timeperframe
        if not (period.numerator and period.denominator):
            return 0
        offered = period.denominator / period.numerator
        if self._rate > 0.0 and abs(offered / self._rate - 1.0) > _RATE_TOLERANCE:
            raise InputError(f'{self.name} offers {offered:.4g} Hz, not {self._rate:.4g}')
        period_ns: int = round(SECOND_NS * period.numerator / period.denominator)
        return period_ns

    def _map_buffers(self) -> None:
        request = api.RequestBuffers(count=_BUFFERS, type=api.CAPTURE, memory=api.MMAP)
        for index in range(self._call(api.REQBUFS, request).count):
            buffer = self._call(api.QUERYBUF, api.Buffer(index=index, type=api.CAPTURE, memory=api.MMAP))
            self._maps.append(self._kernel.map(self._fd, buffer.length, buffer.offset))
            self._call(api.QBUF, buffer)

    def _take_buffer(self) -> api.Buffer | None:
        try:
            return self._call(api.DQBUF, api.Buffer(type=api.CAPTURE, memory=api.MMAP))  # type: ignore[no-any-return]
        except BlockingIOError:
            return None

    def _accepted(self, buffer: api.Buffer) -> Counts | None:
        """A copy of the pixels of a filled buffer; None, and counted, if they are not all there."""
        if self._next_sequence is not None:
            # Of 32 bits; some drivers leave it at 0, others begin again.
            lost = (buffer.sequence - self._next_sequence) & 0xFFFFFFFF
            self.events['lost frames'] += lost if lost < 1 << 31 else 0
        self._next_sequence = buffer.sequence + 1
        if buffer.flags & api.FLAG_ERROR:
            self.events['scrambled frames'] += 1
            return None
        layout = self._layout
        if buffer.bytesused < layout.needed:
            self.events['short frames'] += 1
            return None
        pixels = np.ndarray(layout.shape, layout.kind, self._maps[buffer.index], strides=(layout.step, 2))
        return np.array(pixels, dtype=np.uint16)

    def _stamp_ns(self, buffer: api.Buffer) -> int:
        """When the frame began, by the real-time clock.

        Drivers stamp by the monotonic clock: at the start of the exposure, or when the last pixel came, which for an
        array that is read continuously is a period later. Without such a stamp it is the time of arrival less a
        period.
        """
        monotonic, realtime = self._kernel.clocks_ns()
        stamp = realtime
        if buffer.flags & api.FLAG_TIMESTAMP_MASK == api.FLAG_TIMESTAMP_MONOTONIC:
            stamp += buffer.timestamp.sec * SECOND_NS + buffer.timestamp.usec * 1000 - monotonic
            if buffer.flags & api.FLAG_SOURCE_MASK == api.FLAG_SOURCE_START_OF_EXPOSURE:
                return int(stamp)
        return int(stamp - self._period_ns)


def is_video_device(camera: str) -> bool:
    """Whether ``camera`` names a device file rather than recorded pictures."""
    return camera.startswith('/dev/')
