"""Recorded 16-bit pictures in place of a camera: a folder (flirpy's, for instance), a file or a video."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np

from thermal_fiducial.cameras.source import CapturedFrame, EndOfFramesError, now_ns
from thermal_fiducial.core.types import Counts
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import COUNTS_SUFFIXES, pictures_in, read_picture, without_libraries_lines
from thermal_fiducial.files.reading import is_there, require_regular, shown

_STACKS = ('.tif', '.tiff')
_PATIENCE_S = 0.2
#: Pages of a TIFF in memory at a time: a flight has 10,000, of 655 KB each.
_PAGES = 30


class Pictures:
    """A :class:`~thermal_fiducial.cameras.source.FrameSource` that shows pictures at an even rate, stamped when shown.

    Parameters
    ----------
    path : a folder of PNG, TIFF or PGM files, shown in the order of their names; one of them, a TIFF of many
        pages for instance; or a video whose codec keeps 16 bits (FFV1 with gray16le)
    rate : pictures a second [Hz]
    repeat : begin again at the end

    Raises
    ------
    InputError
        There is nothing of this kind.
    """

    def __init__(self, path: str, rate: float = 30.0, *, repeat: bool = True) -> None:
        self.name = path
        self.events: Counter[str] = Counter()
        self._path = Path(path)
        self._period = 1.0 / rate
        self._repeat = repeat
        self._pictures: Iterator[Counts] = iter(())
        #: when the next picture is due, by the monotonic clock [s]
        self._due = 0.0
        if not is_there(self._path):
            raise InputError(
                f'camera {shown(path)}: neither the name of a driver nor a device, folder, picture or video'
            )
        if not any(True for _ in self._one_pass()):
            raise InputError(f'camera {path}: no 16-bit grey picture in it')
        self.events.clear()

    def open(self) -> None:
        """Start with the first picture."""
        self._pictures = self._all()
        self._due = time.monotonic()

    def read(self) -> list[CapturedFrame]:
        """The next picture when it is due; see the protocol."""
        wait = self._due - time.monotonic()
        time.sleep(min(max(wait, 0.0), _PATIENCE_S))
        if wait > _PATIENCE_S:
            return []
        counts = next(self._pictures, None)
        if counts is None:
            raise EndOfFramesError
        # At an even rate, unless reading a picture took longer than its period.
        self._due = max(self._due + self._period, time.monotonic() - self._period)
        return [CapturedFrame(now_ns(), counts)]

    def close(self) -> None:
        """Nothing to release."""

    def _all(self) -> Iterator[Counts]:
        shown = True
        while shown:
            shown = False
            for picture in self._one_pass():
                yield picture
                shown = self._repeat

    def _one_pass(self) -> Iterator[Counts]:
        for picture in self._stored():
            if picture is not None and picture.dtype == np.uint16 and picture.ndim == 2:
                yield np.asarray(picture, dtype=np.uint16)
            else:
                self.events['unusable pictures'] += 1

    def _stored(self) -> Iterator[Any]:
        if self._path.is_dir():
            return map(_picture, pictures_in(self._path, COUNTS_SUFFIXES))
        require_regular(self._path)
        suffix = self._path.suffix.lower()
        if suffix in _STACKS:
            return self._pages()
        return map(_picture, [self._path]) if suffix in COUNTS_SUFFIXES else self._video()

    def _video(self) -> Iterator[Any]:
        video = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        try:
            while (picture := video.read())[0]:
                yield picture[1]
        finally:
            video.release()

    def _pages(self) -> Iterator[Any]:
        pages: Sequence[Any] = [None]
        begin = 0
        while pages:
            try:
                with without_libraries_lines():
                    pages = cv2.imreadmulti(str(self._path), begin, _PAGES, flags=cv2.IMREAD_UNCHANGED)[1]
            except cv2.error:
                yield None
                return
            yield from pages
            begin += _PAGES


def _picture(path: Path) -> Any:
    """The pixels of a file; None if they are not those of a thermal frame."""
    try:
        return read_picture(path, cv2.IMREAD_UNCHANGED)
    except InputError:
        return None
