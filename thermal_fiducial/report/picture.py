"""One picture that says what the package does: a thermal frame with its markers, the map, the error."""

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from PIL import Image

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.core.types import FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.images import image_to_array, stamp_to_ns
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.plots import draw_view, FIDUCIAL, FUSED, INK, styled, thinned

#: A picture for a README: few colours keep it small.
COLOURS = 160


def draw_picture(evaluation: Evaluation, bag: Path, path: Path) -> None:
    """Write the picture as a PNG.

    Parameters
    ----------
    evaluation : the run
    bag : what it was replayed from
    path : the file to write

    Raises
    ------
    InputError
        A run without detections, a bag without the frame, or a path that can't be written.
    """
    stamp_ns = _frame_to_show(evaluation)
    picture = _view(bag, stamp_ns)
    with styled():
        figure = Figure(figsize=(14.0, 4.3), dpi=110)
        frame, above, error = figure.subplots(1, 3, width_ratios=(1.2, 1.0, 1.0))
        _draw_frame(frame, picture, evaluation, stamp_ns)
        draw_view(above, evaluation)
        above.set_title('The map from above')
        above.legend(loc='upper left', fontsize=7.5, borderaxespad=0.1)
        _draw_error(error, evaluation)
        buffer = io.BytesIO()
        figure.savefig(buffer, format='png', facecolor='white')
    try:
        Image.open(buffer).convert('RGB').quantize(COLOURS).save(path, optimize=True)
    except OSError as problem:
        raise InputError(f'{path}: {problem.strerror}') from None


def _frame_to_show(evaluation: Evaluation) -> int:
    """Stamp of the frame with most markers of the map; of several, one in the middle of the flight."""
    frames, counts = np.unique(evaluation.run.detections.stamps_ns[~evaluation.strangers], return_counts=True)
    if not len(frames):
        raise InputError(f'{evaluation.run.path}: no marker was detected, so there is nothing to draw')
    best = frames[counts == counts.max()]
    best = best[~np.isin(best, evaluation.run.detections.stamps_ns[evaluation.strangers])]
    return int(best[len(best) // 2] if len(best) else frames[np.argmax(counts)])


def _view(bag: Path, stamp_ns: int) -> Gray:
    """The frame in 8 bit, its scale and bad pixels from the second before it."""
    cleaner, view, picture = FrameCleaner(Tau2CameraConfig()), EightBitView(Tau2CameraConfig()), None
    with BagReader(bag) as reader:
        for item in reader.messages([reader.image_topic]):
            if not stamp_ns - 1_000_000_000 < item.stamp_ns < stamp_ns + 1_000_000_000:
                continue
            stamp = stamp_to_ns(item.message.header.stamp)
            clean = cleaner.process(stamp, image_to_array(item.message))
            if clean.counts is not None:
                picture = view(clean.counts)
            if stamp >= stamp_ns and picture is not None:
                return picture
    raise InputError(f'{bag} has no frame of stamp {stamp_ns}')


def _draw_frame(axis: Axes, picture: Gray, evaluation: Evaluation, stamp_ns: int) -> None:
    detections = evaluation.run.detections
    here = detections.stamps_ns == stamp_ns
    axis.imshow(picture, cmap='inferno', interpolation='nearest')
    for marker, corners in zip(detections.ids[here], detections.corners_px[here], strict=True):
        axis.fill(*corners.T, fill=False, edgecolor='#22d3ee', linewidth=1.4)
        axis.text(
            corners[:, 0].min(),
            corners[:, 1].min(),
            f'{marker} ',
            color='#22d3ee',
            fontsize=9,
            weight='bold',
            ha='right',
            va='bottom',
        )
    axis.set_axis_off()
    axis.set_title(f'What the thermal camera sees: {int(here.sum())} markers found', color=INK)


def _draw_error(axis: Axes, evaluation: Evaluation) -> None:
    for e, colour, name in (
        (evaluation.fiducial_errors, FIDUCIAL, 'fiducial only'),
        (evaluation.fused_errors, FUSED, 'fused'),
    ):
        if e is not None and len(e):
            shown = thinned(len(e))
            error: FloatArray = 1e3 * e.position_m
            rms = float(np.sqrt(np.mean(error**2)))
            axis.plot(
                evaluation.seconds(e.stamps_ns[shown]),
                error[shown],
                '.',
                color=colour,
                markersize=2.5,
                label=f'{name}: {rms:.1f} mm rms',
            )
    axis.set_yscale('log')
    axis.set_ylim(bottom=0.1)
    axis.set_xlabel('time [s]')
    axis.set_ylabel('position error [mm]')
    axis.set_title('Error against ground truth')
    if axis.get_legend_handles_labels()[0]:
        axis.legend(loc='upper right', markerscale=4)
