"""A video of a run: thermal frames with markers, time, state and position, by PyAV."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.packages import is_installed, remedy
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import new_file
from thermal_fiducial.report.frames import annotated, bag_of, refuse_other_flight, views, write
from thermal_fiducial.report.interruptions import Cause, interruptions
from thermal_fiducial.report.run_folder import Run

#: Frame rate of the video if the bag has fewer than three frames [Hz].
_FALLBACK_RATE = 30.0
#: Largest stamp difference of a frame and the fused pose in its caption [ns].
_NEAR_NS = 20_000_000
_LINE_PX = 26

_BgrPixels = npt.NDArray[np.uint8]


def require_encoder() -> None:
    """Raise InputError if PyAV is not installed."""
    if not is_installed('av'):
        raise InputError(f'--video needs PyAV: {remedy("video")}')


def write_video(
    run: Run, path: Path, bag: Path | None = None, progress: Callable[[float], None] = lambda share: None
) -> None:
    """Write the video of a run.

    Parameters
    ----------
    run : the run
    path : an ``.mp4`` file (H.264)
    bag : the replayed bag; default: its recorded path
    progress : called with the share done, 0 to 1

    Raises
    ------
    InputError
        No encoder, no bag or that of another flight, or a file that cannot be written.
    """
    require_encoder()
    replayed = bag_of(run, bag)
    if replayed is None:
        raise InputError(f'{run.path}: no video: the bag is not where it was (--bag names it)')
    with replayed as reader:
        refuse_other_flight(run, reader)
        count = max(1, reader.message_count([reader.image_topic]))
        rate = _rate(reader, count)
        frames = _captioned(run, reader)
        first = next(frames, None)
        if first is None:
            raise InputError(f'{reader.path}: no video: the bag has no usable frame')
        # An incomplete video is useless, and the report may show an earlier one.
        with new_file(path) as new, naming(path), _encoded(new, first, rate) as take:
            take(first)
            for index, frame in enumerate(frames, 2):
                take(frame)
                progress(min(1.0, index / count))


def _rate(reader: BagReader, count: int) -> float:
    seconds = reader.duration_ns / SECOND_NS
    return round(count / seconds, 2) if count > 2 and seconds > 0.0 else _FALLBACK_RATE


def _captioned(run: Run, reader: BagReader) -> Iterator[_BgrPixels]:
    """The frames with markers and captions; a dropped frame repeats the last one, with the reason."""
    last: _BgrPixels | None = None
    start_ns: int | None = None
    closed = [(entry.start_ns, entry.end_ns) for entry in interruptions(run, None) if entry.is_shutter]
    for view in views(reader, run.front_end):
        start_ns = view.stamp_ns if start_ns is None else start_ns
        if view.pixels is not None:
            last = view.pixels
        if last is None:
            continue
        picture = annotated(last, run.detections, view.stamp_ns) if view.pixels is not None else last.copy()
        # The first frames with a closed shutter are reported as frozen.
        in_shutter = any(start < view.stamp_ns + run.offset_ns < end for start, end in closed)
        reason = Cause.SHUTTER.value if view.reason and in_shutter else view.reason
        lines = [f'{(view.stamp_ns - start_ns) / SECOND_NS:6.2f} s  {reason}', _place(run, view.stamp_ns)]
        for row, line in enumerate(lines):
            write(picture, line, (8, picture.shape[0] - 10 - _LINE_PX * (len(lines) - 1 - row)))
        # H.264 with chroma subsampling needs even sizes.
        yield picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]


def _place(run: Run, stamp_ns: int) -> str:
    """The filter's position at a frame."""
    fused = run.fused
    if not len(fused):
        return 'no pose'
    at = min(int(np.searchsorted(fused.stamps_ns, stamp_ns + run.offset_ns)), len(fused) - 1)
    if abs(int(fused.stamps_ns[at]) - stamp_ns - run.offset_ns) > _NEAR_NS:
        return 'no pose'
    p: FloatArray = fused.positions[at]
    # Without "z" places just below zero are written -0.00.
    return f'x {p[0]:z.2f}  y {p[1]:z.2f}  z {p[2]:z.2f} m'


@contextmanager
def _encoded(path: Path, first: _BgrPixels, rate: float) -> Iterator[Callable[[_BgrPixels], None]]:
    """Context with a function that takes the frames of a video, all of the size of the ``first`` one."""
    from fractions import Fraction

    import av

    height, width = first.shape[:2]
    try:
        with av.open(str(path), 'w') as container:
            stream = container.add_stream('libx264', rate=Fraction(rate).limit_denominator(1000), options={'crf': '24'})
            stream.width, stream.height, stream.pix_fmt = width, height, 'yuv420p'

            def take(frame: _BgrPixels) -> None:
                picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format='bgr24')
                container.mux(stream.encode(picture))

            yield take
            container.mux(stream.encode())
    except (OSError, av.error.FFmpegError) as error:
        raise InputError(f'PyAV cannot write the video: {error.strerror or error}') from None
