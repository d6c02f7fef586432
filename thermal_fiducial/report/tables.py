"""The measures as rows of text, for the page and the terminal alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from thermal_fiducial.core.filter.innovations import INNOVATIONS
from thermal_fiducial.report.evaluation import Evaluation


@dataclass(frozen=True)
class Table:
    """A title, column heads and rows of cells; ``textual``: cells are words, not numbers."""

    title: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    textual: bool = False


@dataclass(frozen=True)
class Card:
    """One number of the top of the page, with the same from the markers alone, or a note."""

    name: str
    value: str
    unit: str = ''
    fiducial: str = ''
    note: str = ''


def number(value: float | None, digits: int = 3) -> str:
    """``value`` to ``digits`` significant digits, never in powers of ten."""
    if value is None:
        return '–'
    if value == 0.0:
        return '0'
    text = f'{value:.{digits}g}'
    return f'{value:.0f}' if 'e+' in text else f'{float(text):.6f}'.rstrip('0').rstrip('.') if 'e-' in text else text


_BOTH = (
    ('position error, rms [mm]', 'error', 'position_rms_mm'),
    ('position error, median [mm]', 'error', 'position_median_mm'),
    ('position error, 95 % [mm]', 'error', 'position_p95_mm'),
    ('position error, largest [mm]', 'error', 'position_max_mm'),
    ('position error after rigid alignment, rms [mm]', 'error', 'position_aligned_rms_mm'),
    ('attitude error, rms [deg]', 'error', 'attitude_rms_deg'),
    ('attitude error, 95 % [deg]', 'error', 'attitude_p95_deg'),
    ('attitude error, largest [deg]', 'error', 'attitude_max_deg'),
    ('jitter over 1/30 s, position, rms [mm]', 'jitter', 'position_mm'),
    ('jitter over 1/30 s, attitude, rms [deg]', 'jitter', 'attitude_deg'),
    ('relative error over 1 s, position, rms [mm]', 'relative_error', 'position_mm'),
    ('relative error over 1 s, attitude, rms [deg]', 'relative_error', 'attitude_deg'),
)

_OUTPUT = (
    ('poses', 'poses'),
    ('rate [Hz]', 'rate_hz'),
    ('longest pause [ms]', 'longest_pause_ms'),
    ('step at a correction, 95 % [mm]', 'step_p95_mm'),
    ('step at a correction, largest [mm]', 'step_max_mm'),
    ('way [m]', 'way_m'),
)

_MARKERS = (
    ('detections', 'detections'),
    ('frames with markers', 'frames_with_markers'),
    ('markers in such a frame, mean', 'seen_in_a_frame'),
    ('different markers', 'different'),
    ('corner sigma, median [px]', 'corner_sigma_median_px'),
    ('markers in the map', 'in_map'),
    ('detections of markers that are not in it', 'detections_not_in_map'),
)


def tables(evaluation: Evaluation, numbers: dict[str, Any]) -> list[Table]:
    """All tables that the run has something for."""
    made = [
        _accuracy(numbers),
        _consistency(numbers),
        _innovations(numbers),
        Table('Output', ('', 'fused'), _pick(numbers['fused'], _OUTPUT)),
        _latency(numbers),
        Table('Markers', ('', ''), _pick(numbers['markers'], _MARKERS)),
        _gaps(evaluation),
        _load(evaluation),
        _diagnostics(evaluation),
        _figures(evaluation),
    ]
    return [table for table in made if table.rows]


def _pick(values: dict[str, Any], rows: tuple[tuple[str, str], ...]) -> list[tuple[str, ...]]:
    return [(name, number(values[key], 4)) for name, key in rows if values.get(key) is not None]


def _accuracy(numbers: dict[str, Any]) -> Table:
    rows = []
    for name, part, key in _BOTH:
        fused, fiducial = (numbers[source].get(part, {}).get(key) for source in ('fused', 'fiducial'))
        if fused is not None or fiducial is not None:
            rows.append((name, number(fused), number(fiducial)))
    return Table('Accuracy', ('', 'fused', 'fiducial'), rows)


def _consistency(numbers: dict[str, Any]) -> Table:
    values = numbers['fused'].get('consistency', {})
    rows = [
        (name, number(values[f'{name}_nees_per_dof']), f'{100 * values[f"{name}_within_95"]:.1f} %')
        for name in ('pose', 'position', 'attitude')
        if f'{name}_nees_per_dof' in values
    ]
    return Table('Consistency of the covariance', ('', 'NEES per degree of freedom', 'within the 95 % region'), rows)


def _innovations(numbers: dict[str, Any]) -> Table:
    values = numbers.get('innovations', {})
    rows = [('camera poses compared', str(values['poses'])), ('refused', str(values['refused']))] if values else []
    if 'nis_per_dof' in values:
        rows += [
            ('NIS per degree of freedom', number(values['nis_per_dof'])),
            ('within the 95 % band', f'{100 * values["within_95"]:.1f} %'),
            ('above it', f'{100 * values["above_95"]:.1f} %'),
        ]
    return Table('Innovations of the filter', ('', ''), rows)


def _latency(numbers: dict[str, Any]) -> Table:
    rows = [
        (kind.replace('_', ' '), number(values['p50_ms']), number(values['p99_ms']), number(values['max_ms']))
        for kind, values in numbers.get('latency', {}).items()
    ]
    return Table('Latency', ('', 'median [ms]', '99 % [ms]', 'largest [ms]'), rows)


def _gaps(evaluation: Evaluation) -> Table:
    rows = [
        (
            f'{evaluation.seconds_at(gap.start_ns):.2f} s',
            f'{gap.seconds:.2f}',
            str(gap.fused_poses),
            number(gap.error_mm),
            number(gap.error_deg),
            number(gap.step_mm),
        )
        for gap in evaluation.gaps
    ]
    heads = (
        'from',
        'length [s]',
        'fused poses',
        'error at its end [mm]',
        'error [deg]',
        'step when markers return [mm]',
    )
    return Table('Drop-outs: times without a fiducial pose', heads, rows)


def _diagnostics(evaluation: Evaluation) -> Table:
    rows = [(said.node, said.level, said.message, f'{said.count} x') for said in evaluation.run.output.diagnostics]
    return Table('What the nodes said, once a second', ('node', 'level', 'message', 'times'), rows, textual=True)


def _load(evaluation: Evaluation) -> Table:
    used = evaluation.run.summary.get('cpu_percent', {})
    return Table('Processor load', ('', 'of one core [%]'), [(node, number(value)) for node, value in used.items()])


def _figures(evaluation: Evaluation) -> Table:
    """What the nodes counted, but for the traffic on their topics."""
    said = evaluation.run.summary.get('diagnostics', {})
    rows = [
        (node, name, str(value))
        for node, figures in said.items()
        for name, value in figures.items()
        if value not in ('', '0') and not name.startswith(('received ', 'published ', INNOVATIONS))
    ]
    return Table('What the nodes counted, at the end', ('node', 'figure', 'value'), rows, textual=True)


def cards(evaluation: Evaluation, numbers: dict[str, Any]) -> list[Card]:
    """The numbers that a stranger looks for first."""
    fused, fiducial, markers = numbers['fused'], numbers['fiducial'], numbers['markers']
    made = [
        _compared('Position error', 'mm', fused, fiducial, 'error', 'position_rms_mm'),
        _compared('Attitude error', 'deg', fused, fiducial, 'error', 'attitude_rms_deg'),
        _compared('Jitter from frame to frame', 'mm', fused, fiducial, 'jitter', 'position_mm'),
        Card(
            'Output',
            number(fused.get('rate_hz')),
            'Hz',
            note=f'{fused["poses"]} poses, {fiducial["poses"]} from markers',
        ),
        Card(
            'Markers', str(markers['different']), 'seen', note=f'{markers["seen_in_a_frame"]:.1f} in a frame with any'
        ),
        _gap_card(evaluation),
    ]
    if 'imu_to_pose' in numbers.get('latency', {}):
        values = numbers['latency']['imu_to_pose']
        made.append(
            Card('Latency, IMU to pose', number(values['p50_ms']), 'ms', note=f'{number(values["p99_ms"])} ms at 99 %')
        )
    return [card for card in made if card is not None]


def _compared(
    name: str, unit: str, fused: dict[str, Any], fiducial: dict[str, Any], part: str, key: str
) -> Card | None:
    value, other = fused.get(part, {}).get(key), fiducial.get(part, {}).get(key)
    if value is None:
        return None
    return Card(name, number(value), unit, fiducial='' if other is None else f'{number(other)} {unit}', note='rms')


def _gap_card(evaluation: Evaluation) -> Card:
    longest = max((gap.seconds for gap in evaluation.gaps), default=0.0)
    if not evaluation.gaps:
        return Card('Without markers', '0', 's', note='no drop-out over 0.3 s')
    worst = max((gap.error_mm for gap in evaluation.gaps if gap.error_mm is not None), default=None)
    times = f'{len(evaluation.gaps)} drop-out{"s" if len(evaluation.gaps) > 1 else ""}'
    note = times if worst is None else f'{times}, at worst {number(worst)} mm off'
    return Card('Longest time without markers', f'{longest:.1f}', 's', note=note)
