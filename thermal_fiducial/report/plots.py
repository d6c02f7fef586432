"""The pictures of the report, each an SVG: fiducial-only red, fused blue, as in the paper."""

from collections.abc import Iterator
from contextlib import contextmanager
import io
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from thermal_fiducial.core.geometry.planar_pose import marker_corners
from thermal_fiducial.core.geometry.se3 import apply
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.metrics import CHI2_BAND_6, GAP_NS
from thermal_fiducial.report.trajectory import Trajectory

FIDUCIAL, FUSED, TRUTH, SEEN, UNSEEN = '#e5484d', '#2563eb', '#64748b', '#e5484d', '#16a34a'
INK, FAINT, GRID = '#0f172a', '#64748b', '#e2e8f0'

LATENCY_COLOURS = {'imu_to_pose': FUSED, 'image_to_camera_pose': FIDUCIAL, 'image_to_corrected_pose': '#a855f7'}

#: A line has no more points than the page has pixels for.
MOST_POINTS = 1200
#: Less than this is drawn as this: the axis is logarithmic.
LEAST_NIS = 0.03

STYLE: Any = {
    'font.family': 'DejaVu Sans',
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
    'grid.color': GRID,
    'grid.linewidth': 0.7,
    'xtick.color': FAINT,
    'ytick.color': FAINT,
    'lines.solid_capstyle': 'round',
    'legend.frameon': False,
    'figure.constrained_layout.use': True,
    'svg.hashsalt': 'thermal_fiducial',
}


@contextmanager
def styled() -> Iterator[None]:
    """The look that all pictures share."""
    with matplotlib.rc_context(STYLE):
        yield


def svg(figure: Figure) -> str:
    """The picture as an SVG element, the same bytes for the same data."""
    buffer = io.StringIO()
    figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None}, transparent=True)
    text = buffer.getvalue()
    return text[text.index('<svg') :]


def thinned(length: int, most: int = MOST_POINTS) -> IntArray:
    """Indices of at most ``most`` of ``length`` samples, evenly."""
    return (
        np.unique(np.linspace(0, length - 1, min(length, most)).round().astype(np.int64))
        if length
        else np.zeros(0, np.int64)
    )


def euler_deg(T: FloatArray) -> FloatArray:
    """Roll, pitch and yaw (N, 3) [deg] of T (N, 4, 4), continuous over time."""
    R = T[:, :3, :3]
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.asarray(np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=1), axis=0)))


def near(angles: FloatArray, reference: FloatArray) -> FloatArray:
    """``angles`` (N, 3) [deg] on the turn on which ``reference`` (3,) is."""
    return angles - 360.0 * np.round((angles[:1] - reference) / 360.0) if len(angles) else angles


def pose_over_time(evaluation: Evaluation) -> str:
    """Position and attitude over time."""
    run = evaluation.run
    with styled():
        figure = Figure(figsize=(11.5, 5.6))
        axes = figure.subplots(3, 2, sharex=True)
        origin = _origin(evaluation)
        for trajectory, draw in ((run.truth, _truth), (run.fiducial, _fiducial), (run.fused, _fused)):
            if trajectory is None or not len(trajectory):
                continue
            shown = trajectory.take(thinned(len(trajectory)))
            values = np.concatenate([shown.positions, near(euler_deg(shown.T_map_body), origin)], axis=1)
            for axis, value in zip(axes.T.ravel(), values.T, strict=True):
                draw(axis, evaluation.seconds(shown.stamps_ns), value)
        for axis, name in zip(
            axes.T.ravel(), ('x [m]', 'y [m]', 'z [m]', 'roll [deg]', 'pitch [deg]', 'yaw [deg]'), strict=True
        ):
            axis.set_ylabel(name)
            _shade_gaps(axis, evaluation)
        axes[0, 0].set_title('Position in the map')
        axes[0, 1].set_title('Attitude')
        _time_axis(axes[2], evaluation)
        _legend(figure, axes[0, 0])
        return svg(figure)


def _origin(evaluation: Evaluation) -> FloatArray:
    run = evaluation.run
    first = run.fused if len(run.fused) else run.fiducial
    return euler_deg(first.T_map_body[:1])[0] if len(first) else np.zeros(3)


def _truth(axis: Axes, t: FloatArray, value: FloatArray) -> None:
    axis.plot(t, value, color=TRUTH, linewidth=3.5, alpha=0.35, label='ground truth')


def _fiducial(axis: Axes, t: FloatArray, value: FloatArray) -> None:
    axis.plot(t, value, '.', color=FIDUCIAL, markersize=2.2, label='fiducial only')


def _fused(axis: Axes, t: FloatArray, value: FloatArray) -> None:
    axis.plot(t, value, color=FUSED, linewidth=1.1, label='fused')


def _shade_gaps(axis: Axes, evaluation: Evaluation) -> None:
    for index, gap in enumerate(evaluation.gaps):
        start, end = evaluation.seconds(np.array([gap.start_ns, gap.end_ns]))
        axis.axvspan(start, end, color='#f59e0b', alpha=0.13, linewidth=0, label=None if index else 'no markers')


def _time_axis(axes: Any, evaluation: Evaluation) -> None:
    for axis in np.atleast_1d(axes):
        axis.set_xlabel('time [s]')
        axis.set_xlim(0.0, _end(evaluation))


def _end(evaluation: Evaluation) -> float:
    run = evaluation.run
    lasts = [
        stamps[-1] for stamps in (run.fused.stamps_ns, run.fiducial.stamps_ns, run.detections.stamps_ns) if len(stamps)
    ]
    return max(1e-3, float(evaluation.seconds(np.array(lasts)).max())) if lasts else 1.0


def _legend(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        legend = figure.legend(handles, labels, loc='outside upper right', ncols=len(labels))
        for handle in legend.legend_handles:
            if handle is not None and hasattr(handle, 'set_markersize'):
                handle.set_markersize(7)


def map_views(evaluation: Evaluation) -> str:
    """The flight from above and from the side, with the markers of the map: red seen, green not seen."""
    with styled():
        figure = Figure(figsize=(11.5, 5.0))
        above, side = figure.subplots(1, 2)
        draw_view(above, evaluation, (0, 1))
        draw_view(side, evaluation, (0, 2))
        above.set_title('From above')
        side.set_title('From the side')
        _legend(figure, above)
        return svg(figure)


def draw_view(axis: Axes, evaluation: Evaluation, shown: tuple[int, int] = (0, 1)) -> None:
    """Draw two of the three coordinates of flight and markers into ``axis``."""
    run, columns = evaluation.run, list(shown)
    if run.truth is not None:
        _path(axis, run.truth, columns, color=TRUTH, linewidth=4.0, alpha=0.3, label='ground truth')
    _path(axis, run.fiducial, columns, linestyle='', marker='.', markersize=2.0, color=FIDUCIAL, label='fiducial only')
    _path(axis, run.fused, columns, color=FUSED, linewidth=1.3, label='fused')
    if len(run.fused):
        start = run.fused.positions[0, columns]
        axis.plot(*start, 'o', color='white', markeredgecolor=FUSED, markeredgewidth=1.6, label='start')
    _markers(axis, evaluation, columns)
    axis.set_aspect('equal', adjustable='datalim')
    axis.set_xlabel(f'{"xyz"[shown[0]]} [m]')
    axis.set_ylabel(f'{"xyz"[shown[1]]} [m]')
    axis.margins(0.06)


def _path(axis: Axes, trajectory: Trajectory, columns: list[int], **look: Any) -> None:
    points = trajectory.positions[thinned(len(trajectory), 2 * MOST_POINTS)]
    axis.plot(points[:, columns[0]], points[:, columns[1]], **look)


def _markers(axis: Axes, evaluation: Evaluation, columns: list[int]) -> None:
    """Outlines of the markers; those that share a place in this view share a label."""
    if evaluation.run.marker_map is None:
        return
    seen = set(np.unique(evaluation.run.detections.ids).tolist())
    labelled: dict[tuple[float, float], list[int]] = {}
    for kind, colour in (('seen', SEEN), ('not seen', UNSEEN)):
        chosen = [m for m in evaluation.run.marker_map.markers.values() if (m.id in seen) == (kind == 'seen')]
        for index, marker in enumerate(chosen):
            outline = apply(marker.T_map_marker, marker_corners(marker.size))[:, columns]
            label = None if index else f'marker {kind}'
            axis.fill(
                *outline.T,
                facecolor=colour,
                edgecolor=colour,
                linewidth=3.0,
                alpha=0.85,
                joinstyle='miter',
                label=label,
            )
            x, y = outline.mean(axis=0).round(1).tolist()
            labelled.setdefault((x, y), []).append(marker.id)
    for place, ids in labelled.items():
        text = ' '.join(str(i) for i in sorted(ids))
        axis.annotate(text, place, (8.0, 0.0), textcoords='offset points', va='center', fontsize=7.5, color=FAINT)


def errors_over_time(evaluation: Evaluation) -> str | None:
    """Errors with the filter's own three sigma; None where truth isn't known."""
    fused, fiducial = evaluation.fused_errors, evaluation.fiducial_errors
    if fused is None or not len(fused):
        return None
    with styled():
        figure = Figure(figsize=(11.5, 5.6))
        axes = figure.subplots(3, 2, sharex=True)
        for column, axis in enumerate(axes.T.ravel()):
            scale = 1e3 if column < 3 else float(np.rad2deg(1.0))
            if fiducial is not None and len(fiducial):
                shown = thinned(len(fiducial))
                _fiducial(axis, evaluation.seconds(fiducial.stamps_ns[shown]), scale * fiducial.d[shown, column])
            shown = thinned(len(fused))
            t, value = evaluation.seconds(fused.stamps_ns[shown]), scale * fused.d[shown, column]
            _fused(axis, t, value)
            three_sigma = _band(axis, evaluation, column, scale)
            _shade_gaps(axis, evaluation)
            _limit(axis, value, three_sigma)
            axis.set_ylabel(('x [mm]', 'y [mm]', 'z [mm]', 'about x [deg]', 'about y [deg]', 'about z [deg]')[column])
        axes[0, 0].set_title('Position error')
        axes[0, 1].set_title('Attitude error')
        _time_axis(axes[2], evaluation)
        _legend(figure, axes[0, 0])
        return svg(figure)


def _band(axis: Axes, evaluation: Evaluation, column: int, scale: float) -> FloatArray:
    output = evaluation.run.output
    shown = thinned(len(output.stamps_ns))
    three_sigma = 3.0 * scale * np.sqrt(np.maximum(output.covariances[shown, column, column], 0.0))
    t = evaluation.seconds(output.stamps_ns[shown])
    axis.fill_between(t, -three_sigma, three_sigma, color=FUSED, alpha=0.13, linewidth=0, label='3 sigma of the filter')
    return np.asarray(three_sigma)


def _limit(axis: Axes, fused: FloatArray, three_sigma: FloatArray) -> None:
    """Fill the axis with the fused errors and their band: a wild fiducial pose must not hide them."""
    typical = np.percentile(three_sigma, 95) if len(three_sigma) else 0.0
    limit = 1.25 * max(float(np.percentile(np.abs(fused), 99.5)), float(typical), 1e-3)
    axis.set_ylim(-limit, limit)


def innovations_over_time(evaluation: Evaluation) -> str | None:
    """Normalised innovation squared of each camera pose; None where the filter told none."""
    innovations = evaluation.run.output.innovations
    if not len(innovations.nis):
        return None
    with styled():
        figure = Figure(figsize=(11.5, 2.8))
        axis = figure.subplots()
        axis.axhspan(*CHI2_BAND_6, color=FUSED, alpha=0.13, linewidth=0, label='95 % band')
        t, nis = evaluation.seconds(innovations.stamps_ns), np.maximum(innovations.nis, LEAST_NIS)
        for chosen, colour, marker, label in (
            (innovations.accepted, FUSED, '.', 'accepted'),
            (~innovations.accepted, FIDUCIAL, 'x', 'refused'),
        ):
            at = np.flatnonzero(chosen)
            at = at[thinned(len(at), 2 * MOST_POINTS)]
            axis.plot(t[at], nis[at], marker, color=colour, markersize=3.5, label=label)
        axis.set_yscale('log')
        axis.set_ylabel('NIS')
        axis.set_title('Normalised innovation squared')
        _shade_gaps(axis, evaluation)
        _time_axis(axis, evaluation)
        _legend(figure, axis)
        return svg(figure)


def detections_over_time(evaluation: Evaluation) -> str:
    """Which marker was seen when, and how many at once."""
    detections = evaluation.run.detections
    with styled():
        ids = np.unique(detections.ids)
        figure = Figure(figsize=(11.5, 2.6 + 0.14 * min(len(ids), 30)))
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(max(len(ids), 4), 5))
        for row, marker in enumerate(ids):
            for start, end in visible_spans(detections.stamps_ns[detections.ids == marker]):
                left, right = evaluation.seconds(np.array([start, end]))
                upper.barh(row, max(right - left, 0.02), left=left, height=0.62, color=SEEN, linewidth=0)
        upper.set_yticks(range(len(ids)), [str(marker) for marker in ids], fontsize=7.5)
        upper.set_ylim(len(ids) - 0.4, -0.6)
        upper.set_ylabel('marker')
        upper.set_title('Markers in view')
        frames, counts = np.unique(detections.stamps_ns, return_counts=True)
        shown = thinned(len(frames), 2 * MOST_POINTS)
        lower.plot(evaluation.seconds(frames[shown]), counts[shown], '.', color=FUSED, markersize=2.2)
        lower.set_ylim(0, max(counts.max(initial=1) + 0.8, 2))
        lower.set_ylabel('markers a frame')
        for axis in (upper, lower):
            _shade_gaps(axis, evaluation)
        _time_axis(lower, evaluation)
        return svg(figure)


def visible_spans(stamps_ns: IntArray) -> list[tuple[int, int]]:
    """Times from first to last sight without a break of more than the gap of the metrics."""
    if not len(stamps_ns):
        return []
    breaks = np.flatnonzero(np.diff(stamps_ns) > GAP_NS)
    starts = stamps_ns[np.concatenate([[0], breaks + 1])]
    ends = stamps_ns[np.concatenate([breaks, [len(stamps_ns) - 1]])]
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def latency_over_time(evaluation: Evaluation) -> str | None:
    """Time from measurement to result; None for a run that was not in real time."""
    latencies = evaluation.run.latencies
    if not latencies:
        return None
    with styled():
        figure = Figure(figsize=(11.5, 2.6))
        axis = figure.subplots()
        for kind, (stamps, milliseconds) in latencies.items():
            shown = thinned(len(stamps), 2 * MOST_POINTS)
            colour = LATENCY_COLOURS.get(kind, FAINT)
            t = evaluation.seconds(stamps[shown])
            axis.plot(t, milliseconds[shown], '.', color=colour, markersize=2.2, label=kind.replace('_', ' '))
        axis.set_ylim(bottom=0.0)
        axis.set_ylabel('latency [ms]')
        axis.set_title('Latency')
        _time_axis(axis, evaluation)
        _legend(figure, axis)
        return svg(figure)
