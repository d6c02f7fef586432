"""The top of the page: key figures, and facts about the flight."""

from dataclasses import dataclass
from typing import Any

from thermal_fiducial.core.wording import number_of
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.text_table import number


@dataclass(frozen=True)
class Card:
    """One key figure, with a note below it."""

    name: str
    value: str
    unit: str = ''
    note: str = ''


def facts(evaluation: Evaluation, numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Facts about the flight as names and values."""
    summary, marker_map = evaluation.run.summary, evaluation.run.marker_map
    known = [
        ('flight', f'{summary["duration_s"]:.1f} s' if 'duration_s' in summary else ''),
        ('path length', f'{numbers["fused"]["path_length_m"]:.1f} m' if 'path_length_m' in numbers['fused'] else ''),
        ('mode', str(summary.get('mode', ''))),
        ('transport', str(summary.get('transport', ''))),
        ('dictionary', marker_map.dictionary if marker_map else ''),
        ('markers in the map', str(len(marker_map.markers)) if marker_map else ''),
    ]
    return [(name, value) for name, value in known if value]


def cards(evaluation: Evaluation, numbers: dict[str, Any]) -> list[Card]:
    """The key figures."""
    fused, markers = numbers['fused'], numbers['markers']
    made = [
        _compared('Position error', 'mm', numbers, 'position_rms_mm'),
        _compared('Attitude error', 'deg', numbers, 'attitude_rms_deg'),
        _jitter(numbers),
        _map(numbers),
        Card('Output', number(fused.get('rate_hz')), 'Hz', number_of(fused['poses'], 'pose')),
        Card(
            'Markers', str(markers['different']), 'seen', f'{markers["seen_in_a_frame"]:.1f} in a frame with any'
        ),
        _refused(numbers),
        _shutter(evaluation),
        _drop_outs(evaluation),
        _latency(numbers),
    ]  # fmt: skip
    return [card for card in made if card is not None]


def _compared(name: str, unit: str, numbers: dict[str, Any], key: str) -> Card | None:
    """Card of an error as seen by a controller if known, else at each pose's stamp."""
    held = numbers.get('as_available', {}).get('in_view')
    if held:
        others = number(held['markers'][key])
        note = f'rms, as available while markers are in view; markers alone {others}'
        return Card(name, number(held['fused'][key]), unit, note)
    error = numbers['fused'].get('error', {}).get(key)
    if error is None:
        return None
    other = numbers['fiducial'].get('error', {}).get(key)
    return Card(name, number(error), unit, 'rms' if other is None else f'rms; markers alone {number(other)}')


def _jitter(numbers: dict[str, Any]) -> Card | None:
    fused, other = (numbers[name].get('jitter', {}).get('position_mm') for name in ('fused', 'fiducial'))
    if fused is None:
        return None
    note = '' if other is None else f'; markers alone {number(other)}'
    return Card('Jitter from frame to frame', number(fused), 'mm', f'rms{note}')


def _map(numbers: dict[str, Any]) -> Card | None:
    values = numbers.get('map')
    if values is None:
        return None
    moved, every = values['not_fixed'], values['markers']
    measured = number_of(moved, 'marker') if moved else number_of(every, 'fixed marker')
    return Card('Map error', number(values['position_rms_mm']), 'mm', f'rms of {measured}')


def _refused(numbers: dict[str, Any]) -> Card | None:
    values = numbers.get('innovations')
    if values is None:
        return None
    return Card('Refused poses', str(values['refused']), '', f'of {number_of(values["poses"], "camera pose")}')


def _shutter(evaluation: Evaluation) -> Card | None:
    events = [entry for entry in evaluation.interruptions if entry.is_shutter]
    if not events:
        return None
    longest = max(entry.seconds for entry in events)
    unit = 'event' if len(events) == 1 else 'events'
    return Card('Shutter (FFC)', str(len(events)), unit, f'the longest {longest:.2f} s')


def _drop_outs(evaluation: Evaluation) -> Card | None:
    if not len(evaluation.run.fiducial):
        return None
    others = [entry for entry in evaluation.interruptions if entry.is_drop_out]
    if not others:
        return Card('Drop-outs', '0', '', 'no other time over 0.3 s without markers')
    longest = max(entry.seconds for entry in others)
    worst = max((entry.error_mm for entry in others if entry.error_mm is not None), default=None)
    note = f'the longest {longest:.1f} s' + ('' if worst is None else f', at worst {number(worst)} mm off')
    return Card('Drop-outs', str(len(others)), '', note)


def _latency(numbers: dict[str, Any]) -> Card | None:
    values = numbers.get('latency', {}).get('imu_to_pose')
    if values is None:
        return None
    return Card('Latency, IMU to pose', number(values['p50_ms']), 'ms', f'{number(values["p99_ms"])} ms at 99 %')
