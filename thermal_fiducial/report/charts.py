"""Time plots of the report."""

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.interruptions import GAP_NS
from thermal_fiducial.report.metrics import CHI2_BAND_6, PAUSE_NS
from thermal_fiducial.report.stacked_plots import BAND, Chart, FIDUCIAL, FUSED, GOOD, TimePlots, TRUTH

LATENCY_COLOURS = {'imu_to_pose': FUSED, 'image_to_camera_pose': FIDUCIAL, 'image_to_corrected_pose': '#a855f7'}
#: Lower limits of the logarithmic axes, to which smaller values are clipped.
LEAST_NIS, LEAST_MM = 0.03, 0.03


def euler_deg(T: FloatArray) -> FloatArray:
    """Roll, pitch and yaw (N, 3) [deg] of T (N, 4, 4), continuous over time."""
    R = T[:, :3, :3]
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.asarray(np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=1), axis=0)))


def near(angles: FloatArray, reference: FloatArray) -> FloatArray:
    """``angles`` (N, 3) [deg] plus the multiples of 360 that bring the first row nearest to ``reference`` (3,)."""
    return angles - 360.0 * np.round((angles[:1] - reference) / 360.0) if len(angles) else angles


def pose_charts(evaluation: Evaluation) -> list[Chart]:
    """Position and attitude over time."""
    run = evaluation.run
    first = run.fused if len(run.fused) else run.fiducial
    origin = euler_deg(first.T_map_body[:1])[0] if len(first) else np.zeros(3)
    places, angles = TimePlots(('x [m]', 'y [m]', 'z [m]')), TimePlots(('roll [deg]', 'pitch [deg]', 'yaw [deg]'))
    for trajectory, name in ((run.truth, 'ground truth'), (run.fiducial, 'markers alone'), (run.fused, 'fused')):
        if trajectory is None or not len(trajectory):
            continue
        t = evaluation.seconds(trajectory.stamps_ns)
        for plots, values in (
            (places, trajectory.positions),
            (angles, near(euler_deg(trajectory.T_map_body), origin)),
        ):
            for row in range(3):
                _draw(plots, row + 1, t, values[:, row], name)
    for plots in (places, angles):
        plots.shade(evaluation)
    return [
        Chart('position', 'Position in the map', 'Dots: a frame of markers each. Line: the filter.', places.figure),
        Chart('attitude', 'Attitude', 'Turns about the fixed axes x, y, z of the map.', angles.figure),
    ]


def _draw(plots: TimePlots, row: int, t: FloatArray, values: FloatArray, name: str) -> None:
    if name == 'markers alone':
        plots.dots(row, t, values, name, FIDUCIAL)
    elif name == 'fused':
        plots.line(row, t, values, name, FUSED, pause=PAUSE_NS / SECOND_NS)
    else:
        plots.line(row, t, values, name, TRUTH, 3.0)


def error_charts(evaluation: Evaluation) -> list[Chart]:
    """Errors with the filter's three-sigma bounds; none without truth."""
    fused, fiducial, output = evaluation.fused_errors, evaluation.fiducial_errors, evaluation.run.output
    if fused is None or not len(fused):
        return []
    degrees = float(np.rad2deg(1.0))
    made = []
    for name, first, scale, unit in (('Position', 0, 1e3, 'mm'), ('Attitude', 3, degrees, 'deg')):
        plots = TimePlots([f'{axis} [{unit}]' for axis in 'xyz'])
        for row in range(3):
            column = first + row
            sigma = np.sqrt(np.maximum(output.covariances[:, column, column], 0.0))
            if len(sigma):
                plots.band(row + 1, evaluation.seconds(output.stamps_ns), 3.0 * scale * sigma, '3 sigma of the filter')
            if fiducial is not None and len(fiducial):
                t = evaluation.seconds(fiducial.stamps_ns)
                _draw(plots, row + 1, t, scale * fiducial.d[:, column], 'markers alone')
            values = scale * fused.d[:, column]
            _draw(plots, row + 1, evaluation.seconds(fused.stamps_ns), values, 'fused')
            limit = _limit(values, 3.0 * scale * sigma)
            plots.figure.update_yaxes(range=[-limit, limit], row=row + 1, col=1)
        plots.shade(evaluation)
        text = 'Each pose at its own stamp against ground truth, with what the covariance claims.'
        made.append(Chart(f'{name.lower()}_error', f'{name} error', text, plots.figure))
    return made


def _limit(values: FloatArray, three_sigma: FloatArray) -> float:
    """Limit of the axis, so that neither outliers from markers nor the widest part of the band hide the values.

    The band reaches its usual width alone: until clock offset and map are known it is ten times as wide.
    """
    usual = float(np.median(three_sigma)) if len(three_sigma) else 0.0
    return 1.25 * max(float(np.percentile(np.abs(values), 99.5)), usual, 1e-3)


def available_chart(evaluation: Evaluation) -> list[Chart]:
    """Errors of the newest pose at each instant, fused and from the markers alone."""
    known = evaluation.available
    if known is None:
        return []
    plots = TimePlots(('position [mm]', 'attitude [deg]'))
    t = evaluation.seconds(known.instants_ns)
    for name, errors, colour in (('markers alone', known.markers, FIDUCIAL), ('fused', known.fused, FUSED)):
        plots.line(1, t, np.maximum(1e3 * errors[:, 0], LEAST_MM), name, colour)
        plots.line(2, t, np.maximum(np.rad2deg(errors[:, 1]), 1e-3), name, colour)
    plots.make_logarithmic()
    plots.shade(evaluation)
    text = (
        'The newest pose that had come counts until the next one comes, as a controller finds it. '
        f'Median age: markers alone {known.markers_age_ms:.0f} ms, fused {known.fused_age_ms:.1f} ms.'
    )
    return [Chart('available', 'Error as available at each instant', text, plots.figure, wide=True)]


def innovation_chart(evaluation: Evaluation) -> list[Chart]:
    """Normalised innovation squared of each camera pose, per degree of freedom."""
    innovations = evaluation.run.output.innovations
    if not len(innovations.nis):
        return []
    plots = TimePlots(('NIS per d.o.f.',))
    t, nis = evaluation.seconds(innovations.stamps_ns), np.maximum(innovations.nis / 6.0, LEAST_NIS)
    for chosen, colour, symbol, name in (
        (innovations.accepted, FUSED, 'circle', 'accepted'),
        (~innovations.accepted, FIDUCIAL, 'x', 'refused'),
    ):
        if chosen.any():
            plots.dots(1, t[chosen], nis[chosen], name, colour, symbol)
    plots.make_logarithmic()
    low, high = (value / 6.0 for value in CHI2_BAND_6)
    plots.figure.add_hrect(y0=low, y1=high, fillcolor=BAND, line_width=0, layer='below')
    plots.shade(evaluation)
    text = (
        'How far each camera pose lay from what the filter expected, squared, in its standard deviations. '
        '1 on average where the covariances are right, less where they allow for more; the band holds 95 %. '
        f'Less than {LEAST_NIS:g} is drawn as that.'
    )
    return [Chart('innovations', 'Innovations', text, plots.figure)]


def clock_chart(evaluation: Evaluation) -> list[Chart]:
    """Clock offset of the camera and standard deviation of the position, once a second."""
    figures = evaluation.run.output.figures
    if 'time offset' not in figures or 'position std' not in figures:
        return []
    plots = TimePlots(('offset [ms]', 'sigma [mm]'))
    times, offset = figures['time offset']
    t = evaluation.seconds(times)
    plots.line(1, t, 1e3 * offset, 'clock offset of the camera', FUSED)
    sigma_times, sigma = figures.get('time offset std', (times[:0], offset[:0]))
    if len(sigma_times) == len(times):
        for sign in (-3.0, 3.0):
            plots.line(1, t, 1e3 * (offset + sign * sigma), 'its 3 sigma', TRUTH, 1.0)
        centre = float(np.median(offset))
        limit = _limit(1e3 * (offset - centre), 3e3 * sigma)
        plots.figure.update_yaxes(range=[1e3 * centre - limit, 1e3 * centre + limit], row=1, col=1)
    times, position = figures['position std']
    plots.line(2, evaluation.seconds(times), 1e3 * position, 'position, claimed', GOOD)
    plots.figure.update_yaxes(rangemode='tozero', row=2, col=1)
    plots.shade(evaluation)
    text = 'What the filter says of itself once a second. The offset is t_imu - t_camera.'
    return [Chart('clock', 'Clock offset and claimed error', text, plots.figure)]


def detections_chart(evaluation: Evaluation) -> list[Chart]:
    """Visibility of each marker over time, and number of visible markers."""
    detections = evaluation.run.detections
    ids = np.unique(detections.ids)
    plots = TimePlots(('marker', 'in a frame'), (max(len(ids), 4), 4))
    for marker in ids:
        spans = visible_spans(detections.stamps_ns[detections.ids == marker])
        x = evaluation.seconds(np.array([[start, end] for start, end in spans]).reshape(-1, 2))
        x = np.column_stack([x, np.full(len(x), np.nan)]).ravel()
        y = np.full(len(x), float(np.searchsorted(ids, marker)))
        line = {'color': FIDUCIAL, 'width': 7}
        hover = f'marker {marker}<extra></extra>'
        plots.add(1, x, y, 'in view', mode='lines', line=line, hovertemplate=hover, connectgaps=False)
    plots.figure.update_yaxes(
        tickvals=list(range(len(ids))), ticktext=[str(marker) for marker in ids], row=1, col=1, autorange='reversed'
    )
    frames, counts = np.unique(detections.stamps_ns, return_counts=True)
    plots.dots(2, evaluation.seconds(frames), counts.astype(np.float64), 'markers in a frame', FUSED)
    plots.figure.update_yaxes(rangemode='tozero', row=2, col=1)
    plots.figure.update_layout(height=min(620, 200 + 18 * max(len(ids), 4)), hovermode='closest')
    plots.shade(evaluation)
    return [Chart('detections', 'Markers in view', 'Which marker was seen when.', plots.figure)]


def visible_spans(stamps_ns: IntArray) -> list[tuple[int, int]]:
    """Spans (first and last stamp) of sight without a gap as long as an interruption."""
    if not len(stamps_ns):
        return []
    breaks = np.flatnonzero(np.diff(stamps_ns) > GAP_NS)
    starts = stamps_ns[np.concatenate([[0], breaks + 1])]
    ends = stamps_ns[np.concatenate([breaks, [len(stamps_ns) - 1]])]
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def latency_chart(evaluation: Evaluation) -> list[Chart]:
    """Latency from measurement to result; none for a run that was not in real time."""
    if not evaluation.run.latencies:
        return []
    plots = TimePlots(('latency [ms]',))
    for kind, (stamps, milliseconds) in evaluation.run.latencies.items():
        plots.dots(
            1, evaluation.seconds(stamps), milliseconds, kind.replace('_', ' '), LATENCY_COLOURS.get(kind, TRUTH)
        )
    plots.figure.update_yaxes(rangemode='tozero')
    plots.shade(evaluation)
    return [Chart('latency', 'Latency', 'From the arrival of a message to the result.', plots.figure)]
