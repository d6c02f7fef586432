"""V4L2: the interface of linux/videodev2.h, and the driver on a stand-in of the kernel."""

import ctypes
import errno
from pathlib import Path
import shutil
import subprocess

import numpy as np
import pytest

from thermal_fiducial.cameras import v4l2_api as api
from thermal_fiducial.cameras.v4l2 import is_video_device, V4l2Camera
from thermal_fiducial.errors import InputError

HEADER = Path('/usr/include/linux/videodev2.h')
STRUCTURES = {
    'v4l2_capability': api.Capability,
    'v4l2_pix_format': api.PixFormat,
    'v4l2_format': api.Format,
    'v4l2_requestbuffers': api.RequestBuffers,
    'v4l2_buffer': api.Buffer,
    'v4l2_captureparm': api.CaptureParameters,
    'v4l2_streamparm': api.StreamParameters,
}
REQUESTS = (
    'QUERYCAP', 'G_FMT', 'S_FMT', 'REQBUFS', 'QUERYBUF', 'QBUF', 'DQBUF', 'STREAMON', 'G_PARM', 'S_PARM'
)  # fmt: skip
#: name in the header to ours
CONSTANTS = {
    'V4L2_BUF_TYPE_VIDEO_CAPTURE': api.CAPTURE,
    'V4L2_MEMORY_MMAP': api.MMAP,
    'V4L2_FIELD_NONE': api.FIELD_NONE,
    'V4L2_CAP_VIDEO_CAPTURE': api.CAP_VIDEO_CAPTURE,
    'V4L2_CAP_STREAMING': api.CAP_STREAMING,
    'V4L2_CAP_DEVICE_CAPS': api.CAP_DEVICE_CAPS,
    'V4L2_CAP_TIMEPERFRAME': api.CAP_TIMEPERFRAME,
    'V4L2_BUF_FLAG_ERROR': api.FLAG_ERROR,
    'V4L2_BUF_FLAG_TIMESTAMP_MASK': api.FLAG_TIMESTAMP_MASK,
    'V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC': api.FLAG_TIMESTAMP_MONOTONIC,
    'V4L2_BUF_FLAG_TSTAMP_SRC_MASK': api.FLAG_SOURCE_MASK,
    'V4L2_BUF_FLAG_TSTAMP_SRC_SOE': api.FLAG_SOURCE_START_OF_EXPOSURE,
    'V4L2_PIX_FMT_Y16': api.fourcc('Y16 '),
    'V4L2_PIX_FMT_Y16_BE': api.fourcc('Y16 ') | 1 << 31,
    'V4L2_PIX_FMT_Y14': api.fourcc('Y14 '),
}


@pytest.mark.skipif(not (HEADER.exists() and shutil.which('gcc')), reason='no gcc or no linux/videodev2.h')
def test_structures_and_requests_are_those_of_the_header(tmp_path):
    lines = []
    for name, kind in STRUCTURES.items():
        lines.append(f'_Static_assert(sizeof(struct {name}) == {ctypes.sizeof(kind)}, "{name}");')
    for field, _ in api.Buffer._fields_:
        place = getattr(api.Buffer, field).offset
        lines.append(f'_Static_assert(offsetof(struct v4l2_buffer, {field}) == {place}, "{field}");')
    for field, _ in api.PixFormat._fields_:
        place = getattr(api.PixFormat, field).offset + api.Format.fmt.offset
        lines.append(f'_Static_assert(offsetof(struct v4l2_format, fmt.pix.{field}) == {place}, "{field}");')
    place = api.CaptureParameters.timeperframe.offset + api.StreamParameters.parm.offset
    lines.append(f'_Static_assert(offsetof(struct v4l2_streamparm, parm.capture.timeperframe) == {place}, "rate");')
    for name in REQUESTS:
        lines.append(f'_Static_assert(VIDIOC_{name} == {getattr(api, name)}u, "{name}");')
    for name, value in CONSTANTS.items():
        lines.append(f'_Static_assert((unsigned){name} == {value}u, "{name}");')
    source = tmp_path / 'check.c'
    source.write_text('#include <stddef.h>\n#include <linux/videodev2.h>\n' + '\n'.join(lines))
    result = subprocess.run(['gcc', '-fsyntax-only', str(source)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_sizes_on_64_bits():
    # As the header has them on a 64-bit machine, for where there is no compiler.
    sizes = [ctypes.sizeof(kind) for kind in STRUCTURES.values()]
    assert sizes == [104, 48, 208, 20, 88, 40, 204]


# --- a camera that is made of Python ------------------------------------------------------------------

SECOND = 1_000_000_000
#: CLOCK_REALTIME less CLOCK_MONOTONIC of the stand-in [ns].
CLOCK_STEP = 1_700_000_000 * SECOND


class FakeKernel:
    """A Boson: 640 x 512 at 60 or 30 Hz; a test fills its buffers with :meth:`capture`."""

    def __init__(self, **changes):
        self.capabilities = api.CAP_VIDEO_CAPTURE | api.CAP_STREAMING
        self.flags = api.FLAG_TIMESTAMP_MONOTONIC | api.FLAG_SOURCE_START_OF_EXPOSURE
        self.formats, self.sizes, self.rates = ['Y16 ', 'YU12'], [(640, 512)], [60, 30]
        self.padding = 0
        self.plugged, self.now_ns, self.sequence = True, 5 * SECOND, 0
        self.opened, self.streaming, self.queued, self.filled = 0, False, [], []
        self.memory = {}
        self.__dict__.update(changes)
        self.size, self.rate = self.sizes[0], self.rates[0]

    def open(self, path):
        if not self.plugged:
            raise FileNotFoundError(errno.ENOENT, 'No such file or directory', path)
        self.opened += 1
        return 7

    def close(self, fd):
        self.opened -= 1
        self.streaming, self.queued, self.filled = False, [], []

    def clocks_ns(self):
        return self.now_ns, self.now_ns + CLOCK_STEP

    def wait(self, fd, seconds):
        return bool(self.filled) or not self.plugged

    def map(self, fd, length, offset):
        self.memory[offset] = Memory(length)
        return self.memory[offset]

    def ioctl(self, fd, request, argument):
        if not self.plugged:
            raise OSError(errno.ENODEV, 'No such device')
        {
            api.QUERYCAP: self.query, api.G_FMT: self.get_format, api.S_FMT: self.set_format,
            api.G_PARM: self.get_rate, api.S_PARM: self.set_rate, api.REQBUFS: lambda request: None,
            api.QUERYBUF: self.query_buffer, api.QBUF: self.queue, api.DQBUF: self.dequeue,
            api.STREAMON: lambda kind: setattr(self, 'streaming', True),
        }[request](argument)  # fmt: skip

    def query(self, argument):
        if not self.capabilities:
            raise OSError(errno.ENOTTY, 'Inappropriate ioctl for device')
        argument.capabilities, argument.device_caps = 0xFFFFFFFF, self.capabilities

    def get_format(self, argument):
        pix = argument.pix
        (pix.width, pix.height), pix.pixelformat = self.size, api.fourcc(self.formats[-1])
        pix.bytesperline, pix.sizeimage = 123, 456

    def set_format(self, argument):
        assert not self.streaming
        pix = argument.pix
        if pix.pixelformat not in map(api.fourcc, self.formats):
            pix.pixelformat = api.fourcc(self.formats[0])
        self.size = min(self.sizes, key=lambda size: abs(size[0] - pix.width) + abs(size[1] - pix.height))
        pix.width, pix.height = self.size
        pix.bytesperline = 2 * self.size[0] + self.padding
        pix.sizeimage = pix.bytesperline * self.size[1]
        self.format = pix

    def get_rate(self, argument):
        capture = argument.capture
        capture.capability = api.CAP_TIMEPERFRAME if len(self.rates) > 1 else 0
        capture.timeperframe.numerator, capture.timeperframe.denominator = 1, self.rate

    def set_rate(self, argument):
        period = argument.capture.timeperframe
        self.rate = min(self.rates, key=lambda rate: abs(rate - period.denominator / period.numerator))
        self.get_rate(argument)

    def query_buffer(self, argument):
        argument.length, argument.offset = self.format.sizeimage, argument.index * 0x100000

    def queue(self, argument):
        assert argument.index not in self.queued
        self.queued.append(argument.index)

    def dequeue(self, argument):
        if not self.filled:
            raise BlockingIOError(errno.EAGAIN, 'Resource temporarily unavailable')
        for name, value in self.filled.pop(0).items():
            setattr(argument, name, value)

    def capture(self, counts, stamp_ns=0, flags=0, missing=0):
        """The camera takes a picture; without a free buffer it is lost."""
        self.sequence += 1
        if not self.queued:
            return
        index = self.queued.pop(0)
        rows = np.zeros((counts.shape[0], counts.shape[1] + self.padding // 2), counts.dtype)
        rows[:, : counts.shape[1]] = counts
        self.memory[index * 0x100000][: rows.nbytes] = rows.tobytes()
        self.filled.append({
            'index': index, 'bytesused': rows.nbytes - missing, 'flags': self.flags | flags,
            'sequence': self.sequence, 'timestamp': (stamp_ns // SECOND, stamp_ns % SECOND // 1000),
        })  # fmt: skip


class Memory(bytearray):
    """A mapped buffer."""

    def close(self):
        pass


def picture(seed=0, size=(640, 512)):
    return np.random.default_rng(seed).integers(0, 1 << 14, size[::-1], dtype=np.uint16)


def opened(kernel, size=None, rate=0.0):
    camera = V4l2Camera('/dev/video0', size, rate, kernel)
    camera.open()
    return camera


def test_frames_come_with_the_start_of_their_exposure_in_ros_time():
    kernel = FakeKernel()
    camera = opened(kernel)
    assert kernel.streaming
    kernel.capture(picture(1), 4 * SECOND + 1000)
    kernel.capture(picture(2), 4 * SECOND + 16_667_000)
    first, second = camera.read()
    np.testing.assert_array_equal(first.counts, picture(1))
    np.testing.assert_array_equal(second.counts, picture(2))
    assert first.stamp_ns == CLOCK_STEP + 4 * SECOND + 1000
    assert second.stamp_ns == CLOCK_STEP + 4 * SECOND + 16_667_000
    assert camera.read() == []


def test_pixels_are_no_longer_the_drivers():
    kernel = FakeKernel()
    camera = opened(kernel)
    frames = []
    for k in range(20):
        kernel.capture(picture(k))
        frames += camera.read()
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.counts, picture(k))
    assert sorted(kernel.queued) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ('flags', 'expected_ns'),
    [
        # end of the frame: a period of 1/60 s earlier
        (api.FLAG_TIMESTAMP_MONOTONIC, 4 * SECOND - 16_666_667),
        # no clock that could be compared: the time of arrival, a period earlier
        (0, 5 * SECOND - 16_666_667),
        (0x4000 | api.FLAG_SOURCE_START_OF_EXPOSURE, 5 * SECOND - 16_666_667),
    ],
)
def test_other_stamps_are_taken_back_by_a_period(flags, expected_ns):
    kernel = FakeKernel(flags=flags)
    camera = opened(kernel)
    kernel.capture(picture(), 4 * SECOND)
    (frame,) = camera.read()
    assert frame.stamp_ns == CLOCK_STEP + expected_ns


def test_size_and_rate_are_those_that_were_asked_for():
    kernel = FakeKernel(sizes=[(640, 512), (320, 256)], padding=64)
    camera = opened(kernel, (320, 256), 30.0)
    assert (kernel.size, kernel.rate) == ((320, 256), 30)
    kernel.capture(picture(3, (320, 256)))
    (frame,) = camera.read()
    np.testing.assert_array_equal(frame.counts, picture(3, (320, 256)))


def test_big_endian_words_are_swapped():
    kernel = FakeKernel()
    kernel.set_format = lambda argument, original=kernel.set_format: (
        original(argument), setattr(argument.pix, 'pixelformat', api.fourcc('Y16 ') | 1 << 31)
    )  # fmt: skip
    camera = opened(kernel)
    kernel.capture(picture(1).astype('>u2'))
    np.testing.assert_array_equal(camera.read()[0].counts, picture(1))


@pytest.mark.parametrize(
    ('changes', 'size', 'rate', 'reason'),
    [
        ({'capabilities': 0}, None, 0.0, 'is no camera'),
        ({'capabilities': api.CAP_STREAMING}, None, 0.0, 'metadata'),
        ({'formats': ['YUYV', 'MJPG']}, None, 0.0, 'no 16-bit grey .Y16., but YUYV'),
        ({}, (320, 256), 0.0, 'offers 640x512, not 320x256'),
        ({}, None, 9.0, 'offers 30 Hz, not 9'),
        ({'rates': [9]}, None, 30.0, 'one rate only'),
    ],
)
def test_unsupported_settings_of_the_camera_are_refused(changes, size, rate, reason):
    with pytest.raises(InputError, match=reason):
        opened(FakeKernel(**changes), size, rate)


def test_damaged_and_lost_frames_are_counted_and_left_out():
    kernel = FakeKernel()
    camera = opened(kernel)
    kernel.capture(picture(1))
    kernel.capture(picture(2), flags=api.FLAG_ERROR)
    kernel.capture(picture(3), missing=2)
    kernel.capture(picture(4))
    kernel.capture(picture(5))  # no buffer is free
    frames = camera.read()
    kernel.capture(picture(6))
    frames += camera.read()
    assert [int(frame.counts[0, 0]) for frame in frames] == [int(picture(k)[0, 0]) for k in (1, 4, 6)]
    assert camera.events == {'scrambled frames': 1, 'short frames': 1, 'lost frames': 1}


@pytest.mark.parametrize('numbers', [(0, 0, 0), (7, 8, 0), (2**32 - 1, 0, 1)])
def test_numbers_of_frames_that_do_not_count_on_are_no_losses(numbers):
    """A driver that leaves them at 0 counted two thousand million frames as lost with each one."""
    kernel = FakeKernel()
    camera = opened(kernel)
    for number in numbers:
        kernel.sequence = number - 1
        kernel.capture(picture())
        assert len(camera.read()) == 1
    assert not camera.events['lost frames']


def test_a_camera_that_is_unplugged_and_comes_back():
    kernel = FakeKernel()
    camera = opened(kernel)
    kernel.plugged = False
    with pytest.raises(OSError, match='No such device'):
        camera.read()
    camera.close()
    camera.close()
    assert kernel.opened == 0
    with pytest.raises(FileNotFoundError):
        camera.open()
    camera.close()
    kernel.plugged, kernel.sequence = True, 0
    camera.open()
    kernel.capture(picture(9))
    assert len(camera.read()) == 1
    assert camera.events == {}


def test_the_real_system_calls_refuse_a_file_that_is_no_camera():
    camera = V4l2Camera('/dev/null')
    with pytest.raises(InputError, match='/dev/null is no camera'):
        camera.open()
    camera.close()
    with pytest.raises(FileNotFoundError):
        V4l2Camera('/dev/video_that_is_not_there').open()


def test_the_two_clocks_are_read_together():
    first, second = api.Kernel().clocks_ns(), api.Kernel().clocks_ns()
    # far wider than the microseconds between the readings, far narrower than a frame
    assert abs((first[1] - first[0]) - (second[1] - second[0])) < 1_000_000


def test_device_files_are_distinguished_from_pictures():
    assert is_video_device('/dev/v4l/by-id/usb-FLIR_Boson')
    assert not is_video_device('/home/me/pictures')
