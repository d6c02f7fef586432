"""The part of Linux's video interface (linux/videodev2.h) that a grey camera needs: structures, requests, calls."""

import ctypes
from ctypes import c_char, c_int32, c_long, c_uint8, c_uint32, c_ulong
import fcntl
import mmap
import os
import select
import time

CAPTURE, MMAP, FIELD_NONE = 1, 1, 1
CAP_VIDEO_CAPTURE, CAP_STREAMING, CAP_DEVICE_CAPS = 0x00000001, 0x04000000, 0x80000000
CAP_TIMEPERFRAME = 0x1000
FLAG_ERROR = 0x0040
FLAG_TIMESTAMP_MASK, FLAG_TIMESTAMP_MONOTONIC = 0xE000, 0x2000
FLAG_SOURCE_MASK, FLAG_SOURCE_START_OF_EXPOSURE = 0x70000, 0x10000


def fourcc(code: str) -> int:
    """The number of a pixel format."""
    return int.from_bytes(code.encode('ascii'), 'little')


def fourcc_name(number: int) -> str:
    """The pixel format in letters, as far as it has some."""
    return ''.join(chr(byte) for byte in (number & 0x7FFFFFFF).to_bytes(4, 'little') if 32 < byte < 127)


class Capability(ctypes.Structure):
    """v4l2_capability."""

    _fields_ = (
        ('driver', c_char * 16),
        ('card', c_char * 32),
        ('bus_info', c_char * 32),
        ('version', c_uint32),
        ('capabilities', c_uint32),
        ('device_caps', c_uint32),
        ('reserved', c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """v4l2_pix_format."""

    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            'width', 'height', 'pixelformat', 'field', 'bytesperline', 'sizeimage', 'colorspace', 'priv', 'flags',
            'ycbcr_enc', 'quantization', 'xfer_func',
        )
    )  # fmt: skip


class _FormatUnion(ctypes.Union):
    _fields_ = (('pix', PixFormat), ('raw_data', c_uint8 * 200), ('align', c_ulong))


class Format(ctypes.Structure):
    """v4l2_format."""

    _anonymous_ = ('fmt',)
    _fields_ = (('type', c_uint32), ('fmt', _FormatUnion))


class RequestBuffers(ctypes.Structure):
    """v4l2_requestbuffers."""

    _fields_ = (
        ('count', c_uint32),
        ('type', c_uint32),
        ('memory', c_uint32),
        ('capabilities', c_uint32),
        ('flags', c_uint8),
        ('reserved', c_uint8 * 3),
    )


class _Timeval(ctypes.Structure):
    _fields_ = (('sec', c_long), ('usec', c_long))


class _Timecode(ctypes.Structure):
    _fields_ = (('type', c_uint32), ('flags', c_uint32), ('rest', c_uint8 * 8))


class _BufferUnion(ctypes.Union):
    _fields_ = (('offset', c_uint32), ('userptr', c_ulong), ('fd', c_int32))


class Buffer(ctypes.Structure):
    """v4l2_buffer."""

    _anonymous_ = ('m',)
    _fields_ = (
        ('index', c_uint32),
        ('type', c_uint32),
        ('bytesused', c_uint32),
        ('flags', c_uint32),
        ('field', c_uint32),
        ('timestamp', _Timeval),
        ('timecode', _Timecode),
        ('sequence', c_uint32),
        ('memory', c_uint32),
        ('m', _BufferUnion),
        ('length', c_uint32),
        ('reserved2', c_uint32),
        ('request_fd', c_uint32),
    )


class _Fraction(ctypes.Structure):
    _fields_ = (('numerator', c_uint32), ('denominator', c_uint32))


class CaptureParameters(ctypes.Structure):
    """v4l2_captureparm."""

    _fields_ = (
        ('capability', c_uint32),
        ('capturemode', c_uint32),
        ('timeperframe', _Fraction),
        ('extendedmode', c_uint32),
        ('readbuffers', c_uint32),
        ('reserved', c_uint32 * 4),
    )


class _StreamUnion(ctypes.Union):
    _fields_ = (('capture', CaptureParameters), ('raw_data', c_uint8 * 200))


class StreamParameters(ctypes.Structure):
    """v4l2_streamparm."""

    _anonymous_ = ('parm',)
    _fields_ = (('type', c_uint32), ('parm', _StreamUnion))


def _request(number: int, kind: type, *, read: bool, write: bool) -> int:
    """_IOC of asm-generic/ioctl.h: direction, size, letter, number."""
    return (read << 31) | (write << 30) | (ctypes.sizeof(kind) << 16) | (ord('V') << 8) | number


QUERYCAP = _request(0, Capability, read=True, write=False)
G_FMT = _request(4, Format, read=True, write=True)
S_FMT = _request(5, Format, read=True, write=True)
REQBUFS = _request(8, RequestBuffers, read=True, write=True)
QUERYBUF = _request(9, Buffer, read=True, write=True)
QBUF = _request(15, Buffer, read=True, write=True)
DQBUF = _request(17, Buffer, read=True, write=True)
STREAMON = _request(18, c_int32, read=False, write=True)
G_PARM = _request(21, StreamParameters, read=True, write=True)
S_PARM = _request(22, StreamParameters, read=True, write=True)


class Kernel:
    """The system calls, in one place so that a test can stand in for them."""

    def open(self, path: str) -> int:
        """File descriptor of a device, not blocking."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        """Close it."""
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | c_int32) -> None:
        """One request; the answer is in ``argument``."""
        fcntl.ioctl(fd, request, argument)

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """A buffer of the driver."""
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, fd: int, seconds: float) -> bool:
        """Whether there is something to read, or an error, within ``seconds``."""
        return bool(select.select([fd], [], [], seconds)[0])

    def clocks_ns(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC and CLOCK_REALTIME at the same instant [ns]."""
        readings = []
        for _ in range(3):
            before = time.monotonic_ns()
            realtime = time.time_ns()
            after = time.monotonic_ns()
            readings.append((after - before, (before + after) // 2, realtime))
        _, monotonic, realtime = min(readings)
        return monotonic, realtime
