"""Pixels of ``sensor_msgs/msg/Image`` and ``CompressedImage``, from rclpy or from a bag."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import struct
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import Counts, Gray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_bytes

#: Files of pictures by their names: those that keep 16 bits, and all.
COUNTS_SUFFIXES = ('.png', '.tif', '.tiff', '.pgm')
PICTURE_SUFFIXES = (*COUNTS_SUFFIXES, '.jpg', '.jpeg', '.bmp')
#: Accepted encodings to bytes per pixel.
ENCODINGS = {'mono8': 1, '8UC1': 1, 'mono16': 2, '16UC1': 2}
# Largest picture file: 33 megapixels of 16 bits, uncompressed, in colour.
_LARGEST_FILE_BYTES = 250_000_000
#: Where the stamp of a serialised header ends [bytes].
_STAMP_END = 12
#: Magic bytes of lossless formats: PNG, and TIFF of either byte order.
_LOSSLESS = (b'\x89PNG', b'II*\0', b'MM\0*')
# How many times as large steps between neighbours are where bytes are swapped: 256, else a 256th, and 1 in noise. Rows
# that are so far apart show it.
_ROUGHER, _ROW_STEP = 16.0, 64


def image_to_array(message: Any) -> Counts | Gray:
    """Pixels (H, W) in native byte order without row padding, a view if possible.

    Parameters
    ----------
    message : anything with the fields of sensor_msgs/msg/Image, or of CompressedImage as image_transport's
        ``compressed`` makes it with ``format: png``

    Raises
    ------
    InputError
        An encoding other than 8 or 16 bit mono, sizes or bytes that contradict the data, or a lossy compression.
    """
    if hasattr(message, 'format'):
        return _decompressed(message)
    itemsize = ENCODINGS.get(message.encoding)
    if itemsize is None:
        raise InputError(f'image of encoding {message.encoding!r}, not one of {", ".join(ENCODINGS)}')
    height, width, step = int(message.height), int(message.width), int(message.step)
    needed = step * (height - 1) + width * itemsize
    if not (height > 0 and width > 0 and step >= width * itemsize and len(message.data) >= needed):
        raise InputError(
            f'image {width}x{height} {message.encoding} with row step {step} needs {max(needed, 0)} bytes, '
            f'has {len(message.data)}'
        )
    kind = f'{">" if message.is_bigendian else "<"}u{itemsize}'
    pixels: npt.NDArray[Any] = np.ndarray((height, width), kind, message.data, strides=(step, itemsize))
    counts: Counts | Gray = np.ascontiguousarray(pixels, f'u{itemsize}')
    if itemsize == 2 and _is_swapped(counts):
        right = int(not message.is_bigendian)
        raise InputError(f'image {message.encoding} with swapped bytes: its driver must set is_bigendian to {right}')
    return counts


def _is_swapped(counts: npt.NDArray[Any]) -> bool:
    """Whether neighbours among 16-bit ``counts`` (H, W) are alike once the bytes of each are swapped, and only then."""
    rows = counts[::_ROW_STEP]
    # Most of them without a low byte are 8 bits, left-aligned.
    if rows.shape[1] < 2 or 2 * np.count_nonzero(rows & 0xFF) < rows.size:
        return False
    as_is, swapped = (cv2.absdiff(a[:, 1:], a[:, :-1]).mean() for a in (rows, rows.byteswap()))
    return bool(as_is > _ROUGHER * swapped)


def _decompressed(message: Any) -> Counts | Gray:
    data = np.frombuffer(message.data, np.uint8)
    if not data[:4].tobytes().startswith(_LOSSLESS):
        raise InputError(f'compressed image of format {message.format!r}: only PNG keeps the counts')
    pixels: npt.NDArray[Any] | None = None
    with suppress(cv2.error), without_libraries_lines():
        pixels = None if _is_cut_png(data) else cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f'compressed image of {data.size} bytes cannot be decoded')
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f'compressed image of format {message.format!r} is not grey')
    return pixels


def _is_cut_png(data: npt.NDArray[np.uint8]) -> bool:
    """Whether a PNG is truncated; for its claimed size the decoder would allocate gigabytes.

    Chunks follow each other from byte 8 on: length, name, content, check sum (PNG specification, 5.3).
    """
    if data[:4].tobytes() != _LOSSLESS[0]:
        return False
    begin = 8
    while begin + 8 <= data.size:
        length, name = struct.unpack('>I4s', data[begin : begin + 8].tobytes())
        begin += 12 + length
        if name == b'IEND':
            break
    return begin > data.size


def pictures_in(folder: Path, suffixes: Sequence[str] = PICTURE_SUFFIXES) -> list[Path]:
    """Picture files of a folder in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)


def read_picture(path: str | Path, flags: int) -> npt.NDArray[Any]:
    """Pixels of a picture file, as :func:`cv2.imread` reads it.

    Raises
    ------
    InputError
        No such file, not a picture, or too large.
    """
    data = np.frombuffer(read_bytes(path, _LARGEST_FILE_BYTES), np.uint8)
    try:
        with without_libraries_lines():
            pixels = cv2.imdecode(data, flags) if data.size and not _is_cut_png(data) else None
    except cv2.error as error:
        reason = 'it is too large' if 'PIXELS' in str(error) or 'WIDTH' in str(error) else 'it is broken'
        raise InputError(f'{path}: not a readable picture: {reason}') from None
    if pixels is None:
        raise InputError(f'{path}: not a readable picture')
    return pixels


def read_gray(path: str | Path) -> Counts | Gray:
    """Pixels (H, W) of a picture file of 8 or 16 bits; colours are converted to gray.

    Raises
    ------
    InputError
        As :func:`read_picture`, or pixels of another kind, such as temperatures.
    """
    # The calibration is that of the sensor, however the camera was held.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = read_picture(path, flags)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f'{path}: a picture of {pixels.dtype}, not of 8 or 16 bit')
    return pixels


@contextmanager
def without_libraries_lines() -> Iterator[None]:
    """Suppress what libpng and other libraries print to stderr about a broken picture."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def stamp_to_ns(stamp: Any) -> int:
    """Integer nanoseconds of a builtin_interfaces/msg/Time."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def header_stamp_ns(cdr: bytes) -> int:
    """Stamp of a serialised message that begins with a header (4 bytes of encapsulation before it).

    Raises
    ------
    InputError
        The message ends before.
    """
    if len(cdr) < _STAMP_END:
        raise InputError(f'a message of {len(cdr)} bytes, which has no stamp')
    seconds, nanoseconds = struct.unpack_from('<iI' if cdr[1] else '>iI', cdr, 4)
    return int(seconds) * SECOND_NS + int(nanoseconds)
