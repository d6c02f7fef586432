"""The report as one self-contained page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from thermal_fiducial import __version__
from thermal_fiducial.report import plots
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.tables import cards, tables


@dataclass(frozen=True)
class Figure:
    """A picture with its heading."""

    title: str
    text: str
    svg: str


def render(evaluation: Evaluation, numbers: dict[str, Any]) -> str:
    """HTML of a run; ``numbers`` are :meth:`Evaluation.numbers`."""
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string(Path(__file__).with_name('report.html').read_text(encoding='utf-8'))
    bag = str(evaluation.run.summary.get('bag', evaluation.run.path.name))
    page: str = template.render(
        title=bag,
        lead=_lead(evaluation),
        facts=_facts(evaluation, numbers),
        cards=cards(evaluation, numbers),
        figures=_figures(evaluation),
        tables=tables(evaluation, numbers),
        version=__version__,
    )
    return page


def _lead(evaluation: Evaluation) -> str:
    truth = (
        'compared with ground truth'
        if evaluation.run.truth is not None
        else 'without ground truth: no errors are shown'
    )
    return (
        'Thermal frames and IMU of one flight, turned into the pose of the robot in a map of acrylic markers: '
        f'from the markers alone (red) and fused with the IMU (blue), {truth}.'
    )


def _facts(evaluation: Evaluation, numbers: dict[str, Any]) -> list[tuple[str, str]]:
    summary = evaluation.run.summary
    known = [
        ('flight', f'{summary["duration_s"]:.1f} s' if 'duration_s' in summary else ''),
        ('way', f'{numbers["fused"]["way_m"]:.1f} m' if 'way_m' in numbers['fused'] else ''),
        ('mode', str(summary.get('mode', ''))),
        ('transport', str(summary.get('transport', ''))),
        ('dictionary', evaluation.run.marker_map.dictionary if evaluation.run.marker_map else ''),
        ('markers in the map', str(len(evaluation.run.marker_map.markers)) if evaluation.run.marker_map else ''),
    ]
    return [(name, value) for name, value in known if value]


def _figures(evaluation: Evaluation) -> list[Figure]:
    made = [
        Figure(
            'Pose',
            'Red dots: one frame of markers each. Blue: the filter, at IMU rate.',
            plots.pose_over_time(evaluation),
        ),
        Figure('Map', 'The markers of the map, red where they were seen, and the flight.', plots.map_views(evaluation)),
        Figure(
            'Error',
            'Estimate against truth, with three standard deviations as the filter states them (shaded).',
            plots.errors_over_time(evaluation) or '',
        ),
        Figure(
            'Innovations',
            'How far each camera pose lay from what the filter expected, squared, in its standard deviations: 6 on '
            'average where the covariances are right, less where the parameters allow for more.',
            plots.innovations_over_time(evaluation) or '',
        ),
        Figure(
            'Detections',
            'Bars: a marker in view. Amber: no marker for over 0.3 s.',
            plots.detections_over_time(evaluation),
        ),
        Figure('Latency', 'From the arrival of a message to the result.', plots.latency_over_time(evaluation) or ''),
    ]
    return [figure for figure in made if figure.svg]
