"""Summary picture of a run: a thermal frame with its markers, the map, the error."""

import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from PIL import Image

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.frames import annotated, view_at
from thermal_fiducial.report.metrics import rms

#: Number of colours of the PNG; few keep it small for a README.
COLOURS = 160
#: Least error drawn on the logarithmic axis [mm].
_AXIS_FROM_MM = 0.1
FIDUCIAL, FUSED, TRUTH, INK, FAINT = '#e5484d', '#2563eb', '#64748b', '#0f172a', '#64748b'
STYLE: Any = {
    'font.size': 9,
    'axes.edgecolor': '#cbd5e1',
    'axes.labelcolor': FAINT,
    'axes.titlesize': 10,
    'axes.titleweight': 'bold',
    'axes.titlecolor': INK,
    'axes.titlelocation': 'left',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'axes.axisbelow': True,
    'grid.color': '#e2e8f0',
    'xtick.color': FAINT,
    'ytick.color': FAINT,
    'legend.frameon': False,
    'figure.constrained_layout.use': True,
}


def draw_picture(evaluation: Evaluation, bag: Path, path: Path) -> None:
    """Write the picture as a PNG.

    Parameters
    ----------
    evaluation : the run
    bag : the replayed bag
    path : the file to write

    Raises
    ------
    InputError
        A run without detections, a bag without the frame, or a path that cannot be written to.
    """
    stamp_ns = _frame_to_show(evaluation)
    with BagReader(bag) as reader:
        view = view_at(reader, stamp_ns, evaluation.run.front_end)
    if view is None or view.pixels is None:
        raise InputError(f'{bag} has no frame of stamp {stamp_ns}')
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(14.0, 4.3), dpi=110)
        frame, above, error = figure.subplots(1, 3, width_ratios=(1.2, 1.0, 1.0))
        frame.imshow(annotated(view.pixels, evaluation.run.detections, stamp_ns)[:, :, ::-1])
        frame.set_axis_off()
        found = int(np.sum(evaluation.run.detections.stamps_ns == stamp_ns))
        frame.set_title(f'What the thermal camera sees: {number_of(found, "marker")} found')
        _draw_map(above, evaluation)
        draw_error(error, evaluation)
        buffer = io.BytesIO()
        figure.savefig(buffer, format='png', facecolor='white')
    try:
        Image.open(buffer).convert('RGB').quantize(COLOURS).save(path, optimize=True)
    except OSError as problem:
        raise InputError(f'{path}: {problem.strerror}') from None


def _frame_to_show(evaluation: Evaluation) -> int:
    """Stamp of the frame with most mapped markers; of several, the middle one of the flight."""
    frames, counts = np.unique(evaluation.run.detections.stamps_ns[~evaluation.unmapped], return_counts=True)
    if not len(frames):
        raise InputError(f'{evaluation.run.path}: no marker was detected, so there is nothing to draw')
    best = frames[counts == counts.max()]
    best = best[~np.isin(best, evaluation.run.detections.stamps_ns[evaluation.unmapped])]
    return int(best[len(best) // 2] if len(best) else frames[np.argmax(counts)])


def _draw_map(axis: Axes, evaluation: Evaluation) -> None:
    """The flight and the markers from above."""
    run = evaluation.run
    if run.truth is not None:
        axis.plot(*run.truth.positions.T[:2], color=TRUTH, linewidth=4.0, alpha=0.3, label='ground truth')
    axis.plot(*run.fiducial.positions.T[:2], '.', markersize=2.0, color=FIDUCIAL, label='markers alone')
    axis.plot(*run.fused.positions.T[:2], color=FUSED, linewidth=1.3, label='fused')
    markers = [] if run.marker_map is None else list(run.marker_map.markers.values())
    for marker in markers:
        outline = corners_in_map(marker.T_map_marker, marker.size)[:, :2]
        axis.fill(*outline.T, facecolor=FIDUCIAL, edgecolor=FIDUCIAL, linewidth=3.0)
        x, y = outline.mean(axis=0).tolist()
        axis.annotate(str(marker.id), (x, y), (7.0, 0.0), textcoords='offset points', va='center')
    axis.set_aspect('equal', adjustable='datalim')
    axis.set(title='The map from above', xlabel='x [m]', ylabel='y [m]')
    axis.legend(loc='upper left', fontsize=7.5, borderaxespad=0.1)


def draw_error(axis: Axes, evaluation: Evaluation) -> None:
    """Errors as seen by a controller, or at each pose's stamp if arrival times are unknown; the legend above them."""
    axis.set(title='Error against ground truth', xlabel='time [s]', ylabel='position error [mm]')
    largest = 0.0
    for name, colour, t, error in _errors(evaluation):
        axis.plot(t, error, '.', color=colour, markersize=1.5, label=f'{name}: {rms(error):.1f} mm rms')
        largest = max(largest, float(np.nanmax(error)))
    if axis.get_legend_handles_labels()[0]:
        axis.set_yscale('log')
        # A decade above the errors has room for the two rows of the legend.
        axis.set_ylim(_AXIS_FROM_MM, 10.0 * max(largest, _AXIS_FROM_MM))
        axis.yaxis.set_major_formatter('{x:g}')
        axis.legend(loc='upper left', markerscale=5, frameon=False)


def _errors(evaluation: Evaluation) -> list[tuple[str, str, FloatArray, FloatArray]]:
    held = evaluation.available
    if held is not None:
        t = evaluation.seconds(held.instants_ns)
        return [
            ('newest pose of markers', FIDUCIAL, t, 1e3 * held.markers[:, 0]),
            ('newest fused pose', FUSED, t, 1e3 * held.fused[:, 0]),
        ]
    known = ((evaluation.fiducial_errors, FIDUCIAL, 'markers alone'), (evaluation.fused_errors, FUSED, 'fused'))
    return [
        (name, colour, evaluation.seconds(e.stamps_ns), 1e3 * e.position_m)
        for e, colour, name in known
        if e is not None and len(e)
    ]
