"""ThermalGrabber: what counts as a frame, when it was captured, and how the device is opened and lost."""

import pickle
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from support.teax import HEIGHT, packed, picture, WIDTH

from thermal_fiducial.cameras.teax import ThermalGrabber, without_status
from thermal_fiducial.cameras.teax_stream import TeaxStream
from thermal_fiducial.errors import InputError


@pytest.mark.parametrize(('width', 'height'), [(640, 512), (640, 514), (336, 256), (324, 256), (160, 128)])
def test_the_resolution_is_that_of_the_rows(width, height):
    counts = picture(1, width, height)
    (frame,) = TeaxStream().feed(packed(counts), 0)
    np.testing.assert_array_equal(frame.counts, counts)


@pytest.mark.parametrize('size', [None, (640, 512)])
def test_rows_without_blanking_are_those_of_a_known_size(size):
    counts = picture(1, 640, 512)
    data = b'TEAX' + struct.pack('<I', counts.size) + (counts | 0xC000).astype('<u2').tobytes()
    (frame,) = TeaxStream(size).feed(data, 0)
    np.testing.assert_array_equal(frame.counts, counts)


def test_the_length_of_a_known_frame_is_that_of_other_drivers():
    # flirpy and tau2_thermalcapture read 657418 bytes a frame of 640 x 512.
    assert len(packed(picture(1, 640, 512))) == 657418


def test_damaged_frames_are_counted():
    good = packed(picture(1))
    stream = TeaxStream()
    shifted = bytearray(good)
    shifted[2000:2002] = b'\0\0'
    frames = stream.feed(good + good[:9000] + bytes(shifted) + b'noise' + good + packed(picture(1, WIDTH, 130)), 0)
    assert len(frames) == 2
    assert stream.events == {
        'short frames': 1, 'scrambled frames': 1, 'skipped bytes': 5, 'frames of another size': 1
    }  # fmt: skip


def test_several_short_frames_in_one_read():
    good = packed(picture(1))
    stream = TeaxStream()
    data = good[:5000] + good[:300] + good[:20] + good
    assert [len(stream.feed(piece, 0)) for piece in (data, good)] == [1, 1]
    assert stream.events == {'short frames': 3}


def test_another_size_is_taken_when_it_comes_twice_unless_one_was_asked_for():
    data = packed(picture(1)) + packed(picture(2, 336, 256)) + packed(picture(3, 336, 256))
    assert [frame.counts.shape for frame in TeaxStream().feed(data, 0)] == [(HEIGHT, WIDTH), (256, 336)]
    assert [frame.counts.shape for frame in TeaxStream((WIDTH, HEIGHT)).feed(data, 0)] == [(HEIGHT, WIDTH)]


def test_the_stamp_is_when_the_header_came():
    data = packed(picture(1)) * 3
    length = len(data) // 3
    stream, stamps = TeaxStream(), []
    rate = 1_000  # ns a byte
    for end in range(4096, len(data) + 4096, 4096):
        stamps += [frame.stamp_ns for frame in stream.feed(data[end - 4096 : end], min(end, len(data)) * rate)]
    # the first one came with the first read, of which nobody knows when it began
    assert stamps == [4096 * rate, length * rate, 2 * length * rate]


def test_a_pause_before_a_frame_is_no_part_of_it():
    data = packed(picture(1))
    stream = TeaxStream()
    stream.feed(data, 1_000_000)
    assert stream.feed(b'', 30_000_000) == []
    (frame,) = stream.feed(data, 31_000_000)
    assert frame.stamp_ns == 30_000_000


def test_a_long_garble_needs_no_memory():
    stream = TeaxStream()
    for k in range(200):
        stream.feed(bytes(20_000), k)
    # Four million bytes went in.
    assert len(pickle.dumps(stream)) < 2_000


# --- the device ---------------------------------------------------------------------------------------


class TimedOutError(OSError):
    """Stand-in of USBTimeoutError."""


class NoBackendError(ValueError):
    """Stand-in of NoBackendError."""


def in_packets(data):
    """With the two bytes of status before each 510 of data."""
    return b''.join(b'\x32\x60' + data[at : at + 510] for at in range(0, len(data), 510))


class Device:
    """Stand-in of an FT2232H that has some reads ready and is then unplugged."""

    manufacturer, product, serial_number = 'TeAx Technology UG', 'ThermalCapture GrabberUSB', 'T1'

    def __init__(self, reads=()):
        self.reads = list(reads)
        self.calls = []

    def is_kernel_driver_active(self, interface):
        return interface == 0

    def detach_kernel_driver(self, interface):
        self.calls.append(('detach', interface))

    def set_configuration(self, number):
        self.calls.append(('configuration', number))

    def ctrl_transfer(self, *request):
        self.calls.append(request)

    def read(self, endpoint, size, timeout):
        assert (endpoint, size % 512) == (0x81, 0)
        if not self.reads:
            raise OSError(19, 'No such device (it may have been disconnected)')
        read = self.reads.pop(0)
        if read is None:
            raise TimedOutError
        return read


def usb(*devices):
    released = []
    util = SimpleNamespace(claim_interface=lambda device, number: None, dispose_resources=released.append)
    core = SimpleNamespace(find=lambda **_: iter(devices), USBTimeoutError=TimedOutError, NoBackendError=NoBackendError)
    return SimpleNamespace(core=core, util=util, released=released)


def test_status_bytes_are_no_data():
    data = bytes(range(256)) * 9
    assert without_status(in_packets(data)) == data


def test_a_grabber_is_set_up_read_and_lost():
    counts = picture(1)
    data = in_packets(packed(counts))
    device = Device([data[:5120], None, data[5120:]])
    bus = usb(device)
    grabber = ThermalGrabber(usb=bus)
    grabber.open()
    assert device.calls[0] == ('detach', 0)
    assert (0x40, 0x0B, 0x40FF, 1) in device.calls
    assert [len(grabber.read()) for _ in range(3)] == [0, 0, 1]
    with pytest.raises(OSError, match='disconnected'):
        grabber.read()
    grabber.close()
    grabber.close()
    assert bus.released == [device]


def test_the_right_grabber_is_found():
    other, adapter = Device(), Device()
    other.serial_number, adapter.manufacturer, adapter.product = 'T2', 'FTDI', 'Dual RS232-HS'
    with pytest.raises(OSError, match='not plugged in'):
        ThermalGrabber(usb=usb(adapter)).open()
    with pytest.raises(InputError, match='several'):
        ThermalGrabber(usb=usb(Device(), other)).open()
    ThermalGrabber('T2', usb=usb(Device(), other, adapter)).open()
    assert other.calls


def test_a_grabber_without_permission_is_reported():
    class Locked(Device):
        @property
        def manufacturer(self):
            raise ValueError('The device has no langid')

    with pytest.raises(InputError, match='udev'):
        ThermalGrabber(usb=usb(Locked())).open()
