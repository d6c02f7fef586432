"""TeAx ThermalGrabber: a Tau 2 over USB, behind an FT2232H in synchronous FIFO mode, read with pyusb.

Requests and modes are FTDI's, the order of calls is that of flirpy and libthermalgrabber.
"""

from collections import Counter
import importlib
from typing import Any

import numpy as np

from thermal_fiducial.cameras.source import CapturedFrame, now_ns
from thermal_fiducial.cameras.teax_stream import TeaxStream
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.packages import remedy

_VENDOR, _PRODUCT = 0x0403, 0x6010
_VENDOR_REQUEST, _RESET, _SET_LATENCY, _SET_BITMODE = 0x40, 0x00, 0x09, 0x0B
_PURGE_INPUT = 1
_RESET_MODE, _SYNCHRONOUS_FIFO = 0x00FF, 0x40FF
_INTERFACE_A, _ENDPOINT_A = 1, 0x81
#: Bytes of modem status that the chip puts before the data of each packet.
_PACKET, _STATUS = 512, 2
#: Timeout after which the chip sends an incomplete packet [ms]; the shortest possible.
_LATENCY_MS = 1
#: Bytes per read: 3 ms of a 640 x 512 camera at 30 Hz, which is the resolution of the stamps.
_READ = 128 * _PACKET
_TIMEOUT_MS = 200
#: The grabber names itself so; other FT2232H are serial adapters.
_MAKER = 'teax'


def without_status(data: bytes) -> bytes:
    """The payload of the USB packets ``data``."""
    whole = len(data) - len(data) % _PACKET
    packets = np.frombuffer(data, np.uint8, whole).reshape(-1, _PACKET)
    return packets[:, _STATUS:].tobytes() + data[whole + _STATUS :]


class ThermalGrabber:
    """A :class:`~thermal_fiducial.cameras.source.FrameSource`.

    Parameters
    ----------
    serial_number : of the grabber; empty: the only one
    size : (width, height) of the camera; None: as its stream says
    usb : what offers ``core`` and ``util`` as pyusb does; None: pyusb
    """

    def __init__(self, serial_number: str = '', size: tuple[int, int] | None = None, usb: Any = None) -> None:
        self.name = f'ThermalGrabber {serial_number}'.strip()
        self.events: Counter[str] = Counter()
        self._serial_number = serial_number
        self._size = size
        self._usb = usb
        self._device: Any = None
        self._stream = TeaxStream(size, self.events)

    def open(self) -> None:
        """Find the grabber, take it from the kernel's serial driver, and start the stream; see the protocol."""
        self._device = self._find()
        for interface in (0, 1):
            if self._device.is_kernel_driver_active(interface):
                self._device.detach_kernel_driver(interface)
        self._device.set_configuration(1)
        self._usb.util.claim_interface(self._device, 0)
        self._request(_SET_BITMODE, _RESET_MODE)
        self._request(_SET_BITMODE, _SYNCHRONOUS_FIFO)
        self._request(_SET_LATENCY, _LATENCY_MS)
        self._request(_RESET, _PURGE_INPUT)
        self._stream = TeaxStream(self._size, self.events)

    def read(self) -> list[CapturedFrame]:
        """Received frames; see the protocol."""
        try:
            data = bytes(self._device.read(_ENDPOINT_A, _READ, _TIMEOUT_MS))
        except self._usb.core.USBTimeoutError:
            data = b''
        return self._stream.feed(without_status(data), now_ns())

    def close(self) -> None:
        """Release the grabber."""
        device, self._device = self._device, None
        if device is not None:
            self._usb.util.dispose_resources(device)

    def _find(self) -> Any:
        if self._usb is None:
            self._usb = _pyusb()
        try:
            devices = list(self._usb.core.find(find_all=True, idVendor=_VENDOR, idProduct=_PRODUCT))
            wanted = [device for device in devices if self._is_wanted(device)]
        except self._usb.core.NoBackendError:
            raise InputError('ThermalGrabber: libusb is not installed (libusb-1.0-0)') from None
        if len(wanted) > 1:
            raise InputError('ThermalGrabber: several are plugged in; name one, "teax:SERIAL"')
        if not wanted:
            raise OSError(f'{self.name} is not plugged in')
        return wanted[0]

    def _is_wanted(self, device: Any) -> bool:
        """Whether a device matches by serial number, or by its name if USB permits reading it."""
        try:
            if self._serial_number:
                return bool(device.serial_number == self._serial_number)
            return _MAKER in f'{device.manufacturer} {device.product}'.lower()
        except ValueError:
            raise InputError(f'{self.name}: this user may not open it; add a udev rule') from None

    def _request(self, request: int, value: int) -> None:
        self._device.ctrl_transfer(_VENDOR_REQUEST, request, value, _INTERFACE_A)


def _pyusb() -> Any:
    try:
        core, util = importlib.import_module('usb.core'), importlib.import_module('usb.util')
    except ImportError:
        raise InputError(f'ThermalGrabber: pyusb is not installed: {remedy("cameras")}') from None
    return type('usb', (), {'core': core, 'util': util})
