"""Thermal frames with the detections drawn on them: a strip for the page, and all of them for a video."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.images import image_to_array, stamp_to_ns
from thermal_fiducial.report.run_folder import bag_of_run, bag_options, Detections, Run

#: Number of pictures of a strip, and their width [px].
STRIP, STRIP_WIDTH = 12, 480
#: Frames are read from this long before the shown one, to initialise bad pixels and scale, to this long after [ns].
_BEFORE_NS, _AFTER_NS = 150_000_000, 100_000_000
_QUALITY = 72
_CYAN, _YELLOW, _WHITE = (238, 211, 34), (0, 255, 255), (255, 255, 255)
#: Offsets of the black outline of white letters [px]: OpenCV 5's fonts ignore the line thickness.
_EDGE = ((-2, 0), (-1, -1), (0, -2), (1, -1), (2, 0), (1, 1), (0, 2), (-1, 1))
#: Corners are drawn to a sixteenth of a pixel.
_SHIFT = 4


@dataclass(frozen=True)
class ThermalView:
    """A frame in false colours: pixels (H, W, 3) BGR; None if it was dropped, for ``reason``."""

    stamp_ns: int
    pixels: npt.NDArray[np.uint8] | None
    reason: str


@dataclass(frozen=True)
class FramePicture:
    """A picture of the page, as a data URI, with its caption."""

    uri: str
    caption: str


def bag_of(run: Run, bag: Path | None = None) -> BagReader | None:
    """The bag that a run was replayed from, to be opened with the names of its topics; None if it is not found."""
    path = bag or bag_of_run(run.path, run.summary)
    return None if path is None else BagReader(path, **bag_options(run.summary))


def strip(run: Run, bag: Path | None = None) -> list[FramePicture]:
    """Pictures at even intervals over the run; none if the bag is not found.

    Raises
    ------
    InputError
        The bag was given and is of another flight.
    """
    replayed = bag_of(run, bag)
    stamps = run.detections.stamps_ns
    if replayed is None or not len(stamps):
        return []
    start = int(stamps[0])
    pictures = []
    with replayed as reader:
        if bag is not None:
            refuse_other_flight(run, reader)
        for wanted in _even(np.unique(stamps)):
            view = view_at(reader, int(wanted), run.front_end)
            if view is not None and view.pixels is not None:
                drawn = annotated(view.pixels, run.detections, view.stamp_ns)
                count = int(np.sum(stamps == view.stamp_ns))
                seconds = (view.stamp_ns - start) / SECOND_NS
                pictures.append(FramePicture(_uri(drawn), f'{seconds:.1f} s, {number_of(count, "marker")}'))
    return pictures


def refuse_other_flight(run: Run, reader: BagReader) -> None:
    """Raise InputError for a bag without a single one of the frames in which the run found markers."""
    stamps = np.unique(run.detections.stamps_ns)
    if not len(stamps) or any(view_at(reader, int(stamp), run.front_end) for stamp in _even(stamps)):
        return
    first = next(reader.messages([reader.image_topic]), None)
    if first is None:
        raise InputError(f'{reader.path}: no images on {reader.image_topic} in it')
    images, markers = (stamp / SECOND_NS for stamp in (stamp_to_ns(first.message.header.stamp), int(stamps[0])))
    begins = f'its images begin at {images:.1f} s, the markers of the run at {markers:.1f} s'
    raise InputError(f'{reader.path}: not the bag of run {run.path}, as it has none of its frames; {begins}')


def _even(stamps_ns: IntArray) -> IntArray:
    """Stamps of :data:`STRIP` frames, evenly spaced in time."""
    wanted = np.linspace(stamps_ns[0], stamps_ns[-1], STRIP)
    return np.unique(stamps_ns[np.clip(np.searchsorted(stamps_ns, wanted), 0, len(stamps_ns) - 1)])


def view_at(reader: BagReader, stamp_ns: int, front_end: Tau2CameraConfig) -> ThermalView | None:
    """The frame of a stamp, read with the parameters of its run; None where the bag has none."""
    first = next(reader.messages([reader.image_topic]), None)
    if first is None:
        return None
    # Offset between stamps and the recorder's clock, which may be years.
    apart = first.stamp_ns - stamp_to_ns(first.message.header.stamp)
    between = stamp_ns + apart - _BEFORE_NS, stamp_ns + apart + _AFTER_NS
    for view in views(reader, front_end, between):
        if view.stamp_ns == stamp_ns:
            return view
    return None


def views(
    reader: BagReader, front_end: Tau2CameraConfig, between_ns: tuple[int, int] | None = None
) -> Iterator[ThermalView]:
    """Frames of an open bag in false colours, in recorded order; ``between_ns``: of bag stamps."""
    cleaner, scale = FrameCleaner(front_end), EightBitView(front_end)
    for item in reader.messages([reader.image_topic], between_ns):
        stamp = stamp_to_ns(item.message.header.stamp)
        clean = cleaner.process(stamp, image_to_array(item.message))
        if clean.counts is None:
            yield ThermalView(stamp, None, clean.reason)
        else:
            coloured = cv2.applyColorMap(scale(clean.counts), cv2.COLORMAP_INFERNO)
            yield ThermalView(stamp, np.asarray(coloured, np.uint8), '')


def annotated(pixels: npt.NDArray[np.uint8], detections: Detections, stamp_ns: int) -> npt.NDArray[np.uint8]:
    """A copy of a frame with the outlines and IDs of its markers."""
    picture = pixels.copy()
    here = detections.stamps_ns == stamp_ns
    for marker, corners in zip(detections.ids[here].tolist(), detections.corners_px[here], strict=True):
        _draw_marker(picture, marker, corners)
    return picture


def _draw_marker(picture: npt.NDArray[np.uint8], marker: int, corners: FloatArray) -> None:
    fine = np.rint(corners * 2**_SHIFT).astype(np.int32)
    cv2.polylines(picture, [fine], isClosed=True, color=_CYAN, thickness=2, lineType=cv2.LINE_AA, shift=_SHIFT)
    first = (int(fine[0, 0]), int(fine[0, 1]))
    cv2.circle(picture, first, 4 << _SHIFT, _YELLOW, -1, cv2.LINE_AA, _SHIFT)
    write(picture, str(marker), (int(corners[:, 0].max()) + 6, int(corners[:, 1].min()) + 10))


def write(picture: npt.NDArray[np.uint8], text: str, place: tuple[int, int]) -> None:
    """Write text into a picture, white with a black outline, readable on any background."""
    x, y = place
    for dx, dy in _EDGE:
        _put(picture, text, (x + dx, y + dy), (0, 0, 0))
    _put(picture, text, place, _WHITE)


def _put(picture: npt.NDArray[np.uint8], text: str, place: tuple[int, int], ink: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, ink, 2, cv2.LINE_AA)


def _uri(picture: npt.NDArray[np.uint8]) -> str:
    height, width = picture.shape[:2]
    size = (STRIP_WIDTH, round(height * STRIP_WIDTH / width))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if width > STRIP_WIDTH else picture
    _, encoded = cv2.imencode('.webp', small, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return 'data:image/webp;base64,' + base64.b64encode(encoded.tobytes()).decode('ascii')
