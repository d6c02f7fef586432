"""The measures as tables of text, for page and terminal."""

from typing import Any

from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.node_tables import figures_tables, load_table, said_table
from thermal_fiducial.report.text_table import number, Table

_BOTH = (
    ('position error, rms', 'mm', 'error', 'position_rms_mm'),
    ('position error, median', 'mm', 'error', 'position_median_mm'),
    ('position error, 95 %', 'mm', 'error', 'position_p95_mm'),
    ('position error, largest', 'mm', 'error', 'position_max_mm'),
    ('position error after rigid alignment, rms', 'mm', 'error', 'position_aligned_rms_mm'),
    ('attitude error, rms', 'deg', 'error', 'attitude_rms_deg'),
    ('attitude error, 95 %', 'deg', 'error', 'attitude_p95_deg'),
    ('attitude error, largest', 'deg', 'error', 'attitude_max_deg'),
    ('jitter over 1/30 s, position, rms', 'mm', 'jitter', 'position_mm'),
    ('jitter over 1/30 s, attitude, rms', 'deg', 'jitter', 'attitude_deg'),
    ('relative error over 1 s, position, rms', 'mm', 'relative_error', 'position_mm'),
    ('relative error over 1 s, attitude, rms', 'deg', 'relative_error', 'attitude_deg'),
)

_OUTPUT = (
    ('poses', 'count', 'poses'),
    ('rate', 'Hz', 'rate_hz'),
    ('longest pause', 'ms', 'longest_pause_ms'),
    ('time without a pose at the end', 'ms', 'silent_at_end_ms'),
    ('time without the IMU at the end', 'ms', 'imu_silent_at_end_ms'),
    ('step at a correction, 95 %', 'mm', 'step_p95_mm'),
    ('step at a correction, largest', 'mm', 'step_max_mm'),
    ('path length', 'm', 'path_length_m'),
)

_MARKERS = (
    ('detections', 'count', 'detections'),
    ('frames with markers', 'count', 'frames_with_markers'),
    ('markers in such a frame, mean', 'count', 'seen_in_a_frame'),
    ('different markers', 'count', 'different'),
    ('corner sigma, median', 'px', 'corner_sigma_median_px'),
    ('markers in the map', 'count', 'in_map'),
    ('detections of markers that are not in it', 'count', 'detections_not_in_map'),
)

_MAP = (
    ('markers that both maps have', 'count', 'markers'),
    ('of these, not fixed', 'count', 'not_fixed'),
    ('position error, rms', 'mm', 'position_rms_mm'),
    ('position error, largest', 'mm', 'position_max_mm'),
    ('position error after rigid alignment, rms', 'mm', 'position_aligned_rms_mm'),
    ('attitude error, rms', 'deg', 'attitude_rms_deg'),
    ('attitude error, largest', 'deg', 'attitude_max_deg'),
    ('NEES (consistent: 1)', 'per d.o.f.', 'nees_per_dof'),
)

_SPREAD = (
    ('position error, rms', 'mm', 'position_rms_mm'),
    ('position error, 95 %', 'mm', 'position_p95_mm'),
    ('position error, largest', 'mm', 'position_max_mm'),
    ('attitude error, rms', 'deg', 'attitude_rms_deg'),
    ('attitude error, 95 %', 'deg', 'attitude_p95_deg'),
)


def tables(evaluation: Evaluation, numbers: dict[str, Any]) -> dict[str, Table]:
    """All tables that are not empty, by topic."""
    made = {
        **_pilot(numbers),
        'accuracy': _accuracy(numbers),
        'consistency': _consistency(numbers),
        'innovations': _innovations(numbers),
        'output': Table('Output', ('', 'unit', 'fused'), _pick(numbers['fused'], _OUTPUT)),
        'latency': _latency(numbers),
        'interruptions': _interruptions(evaluation),
        'markers': Table('Markers', ('', 'unit', ''), _pick(numbers['markers'], _MARKERS)),
        'map': map_error_table(numbers.get('map', {})),
        'tags': _tags(evaluation),
        'load': load_table(evaluation),
        'diagnostics': said_table(evaluation),
        **figures_tables(evaluation),
    }
    return {name: table for name, table in made.items() if table.rows}


def _pick(values: dict[str, Any], rows: tuple[tuple[str, str, str], ...]) -> list[tuple[str, ...]]:
    return [(name, unit, number(values[key])) for name, unit, key in rows if values.get(key) is not None]


def map_error_table(values: dict[str, Any]) -> Table:
    """Errors of a map from :func:`map_accuracy`."""
    return Table('Error of the map', ('', 'unit', ''), _pick(values, _MAP))


def _accuracy(numbers: dict[str, Any]) -> Table:
    rows = []
    for name, unit, part, key in _BOTH:
        fused, fiducial = (numbers[source].get(part, {}).get(key) for source in ('fused', 'fiducial'))
        if fused is not None or fiducial is not None:
            rows.append((name, unit, number(fused), number(fiducial)))
    return Table('Accuracy of each pose at its own stamp', ('', 'unit', 'fused', 'markers alone'), rows)


def _pilot(numbers: dict[str, Any]) -> dict[str, Table]:
    """Errors as seen by a controller, and those at the stamps of frames, which flatter the markers."""
    held = numbers.get('as_available', {})
    cases = {
        'pilot': ('What a controller has while markers are in view: the newest pose', held.get('in_view')),
        'pilot_always': ('The same in the whole run, shutter events and drop-outs included', held.get('always')),
        'at_frames': ("At frames' instants, when no controller has a pose yet", numbers.get('at_frames')),
    }
    made = {}
    for name, (title, both) in cases.items():
        columns = [both[source] for source in ('fused', 'markers')] if both else []
        rows = [(words, unit, *(number(values[key]) for values in columns)) for words, unit, key in _SPREAD if columns]
        if columns and both is not numbers.get('at_frames'):
            ages = (number(held['age_ms'][source]) for source in ('fused', 'markers'))
            rows.append(('age of the newest pose, median', 'ms', *ages))
        made[name] = Table(title, ('', 'unit', 'fused', 'markers alone'), rows)
    return made


def _consistency(numbers: dict[str, Any]) -> Table:
    values = numbers['fused'].get('consistency', {})
    rows = [
        (name, number(values[f'{name}_nees_per_dof']), f'{100 * values[f"{name}_within_95"]:.1f}')
        for name in ('pose', 'position', 'attitude')
        if f'{name}_nees_per_dof' in values
    ]
    heads = ('', 'NEES, consistent: 1 [per d.o.f.]', 'within the 95 % region [%]')
    return Table('Consistency of the covariance with the errors', heads, rows)


def _innovations(numbers: dict[str, Any]) -> Table:
    values = numbers.get('innovations', {})
    if not values:
        return Table('', (), ())
    rows: list[tuple[str, ...]] = [
        ('camera poses compared with the estimate', 'count', str(values['poses'])),
        ('of these, refused: beyond the gate', 'count', str(values['refused'])),
    ]
    if 'nis_per_dof' in values:
        rows += [
            ('NIS of those accepted (consistent: 1)', 'per d.o.f.', number(values['nis_per_dof'])),
            ('of these, within the 95 % band', '%', f'{100 * values["within_95"]:.1f}'),
            ('above it', '%', f'{100 * values["above_95"]:.1f}'),
        ]
    return Table('Innovations of the filter', ('', 'unit', ''), rows)


def _latency(numbers: dict[str, Any]) -> Table:
    rows = [
        (kind.replace('_', ' '), number(values['p50_ms']), number(values['p99_ms']), number(values['max_ms']))
        for kind, values in numbers.get('latency', {}).items()
    ]
    return Table('Latency', ('', 'median [ms]', '99 % [ms]', 'largest [ms]'), rows)


def _interruptions(evaluation: Evaluation) -> Table:
    rows = [
        (
            entry.cause.value,
            f'{evaluation.seconds_at(entry.start_ns):.2f}',
            f'{entry.seconds:.2f}',
            str(entry.fused_poses),
            number(entry.error_mm),
            number(entry.error_deg),
            number(entry.step_mm),
        )
        for entry in evaluation.interruptions
    ]
    heads = (
        'cause',
        'from [s]',
        'length [s]',
        'fused poses [count]',
        'error at its end [mm]',
        'error [deg]',
        'step when markers return [mm]',
    )
    return Table('Times without a pose from the markers', heads, rows)


def _tags(evaluation: Evaluation) -> Table:
    heads = (
        'marker',
        'views [frames]',
        'first view [s]',
        'corner sigma [px]',
        'residual [px]',
        'sigma [mm]',
        'sigma [deg]',
    )
    with_errors = any(tag.error for tag in evaluation.tags)
    rows = []
    for tag in evaluation.tags:
        first = '–' if tag.first_view_ns is None else f'{evaluation.seconds_at(tag.first_view_ns):.2f}'
        values = (tag.corner_sigma_px, tag.residual_px, tag.sigma_mm, tag.sigma_deg)
        error = (tag.error.position_mm, tag.error.attitude_deg) if tag.error else (None, None)
        row = (str(tag.id), str(tag.views), first, *map(number, values))
        rows.append((*row, *(map(number, error) if with_errors else ()), tag.status, tag.why))
    errors = ('error [mm]', 'error [deg]') if with_errors else ()
    return Table('Markers, one by one', (*heads, *errors, 'status', 'why'), rows)
