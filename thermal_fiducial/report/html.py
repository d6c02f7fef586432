"""Self-contained HTML pages: one file each, with the plot library embedded, usable offline."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import plotly.offline

from thermal_fiducial import __version__
from thermal_fiducial.report import charts
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.frames import FramePicture
from thermal_fiducial.report.overview import Card, cards, facts
from thermal_fiducial.report.space import scene_chart
from thermal_fiducial.report.stacked_plots import Chart
from thermal_fiducial.report.tables import tables
from thermal_fiducial.report.text_table import Table
from thermal_fiducial.report.verdict import judge, RunVerdict

_HERE = Path(__file__).parent
_FOOTER = (
    'Errors are in the frame of the map, without any alignment, against truth interpolated at each stamp. Jitter is '
    'the change of the error over 1/30 s. NEES and NIS are per degree of freedom: 1 is consistent, less is cautious. '
    'A refused pose is one that the filter compared with its estimate and found beyond its gate.'
)


@dataclass(frozen=True)
class Section:
    """A section of a page with an entry in its navigation."""

    name: str
    title: str
    charts: tuple[Chart, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[FramePicture, ...] = ()
    #: text in place of missing pictures
    note: str = ''
    #: file name of a video beside the page
    video: str = ''

    def __bool__(self) -> bool:
        return bool(self.charts or self.tables or self.pictures or self.note or self.video)


@dataclass(frozen=True)
class Page:
    """What a page shows: first the verdict and the key figures, then sections."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = ()
    cards: tuple[Card, ...] = ()
    verdict: RunVerdict | None = None
    footer: str = _FOOTER


def render(page: Page) -> str:
    """HTML of a page."""
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string(_text('report.html'))
    sections = [section for section in page.sections if section]
    shown = [chart for section in sections for chart in section.charts]
    html: str = template.render(
        page=page,
        sections=sections,
        style=_text('report.css'),
        script=_text('report.js'),
        library=plotly.offline.get_plotlyjs() if shown else '',
        figures=[(chart, _json(chart)) for chart in shown],
        version=__version__,
    )
    return html


def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding='utf-8')


def _json(chart: Chart) -> str:
    """The figure as JSON, escaped for a script element."""
    text: str = chart.figure.to_json(engine='json')
    return text.replace('<', '\\u003c')


def report_page(evaluation: Evaluation, numbers: dict[str, Any], pictures: list[FramePicture], video: str) -> Page:
    """The report on a run; ``numbers`` are :meth:`Evaluation.numbers`, ``video`` a file beside the page or empty."""
    made = tables(evaluation, numbers)

    def some(*names: str) -> tuple[Table, ...]:
        return tuple(made[name] for name in names if name in made)

    no_bag = (
        '' if pictures else 'No frames are shown: the bag is not where it was (--bag names it), or it has none of them.'
    )
    sections = (
        Section(
            'errors',
            'Errors',
            _errors(evaluation),
            some('pilot', 'pilot_always', 'at_frames', 'accuracy', 'consistency'),
        ),
        Section('space', 'Path and map', tuple(scene_chart(evaluation)), some('map', 'tags')),
        Section('pose', 'Pose', tuple(charts.pose_charts(evaluation)), some('output')),
        Section('frames', 'Frames', pictures=tuple(pictures), note=no_bag, video=video),
        Section('markers', 'Markers', tuple(charts.detections_chart(evaluation)), some('markers', 'interruptions')),
        Section('filter', 'Filter', _filter(evaluation), some('innovations')),
        Section('speed', 'Latency', tuple(charts.latency_chart(evaluation)), some('latency', 'load')),
        Section(
            'nodes', 'Nodes', tables=some('diagnostics', *(name for name in made if name.startswith('figures of ')))
        ),
    )
    return Page(
        title=str(evaluation.run.summary.get('bag', evaluation.run.path.name)),
        lead=_lead(evaluation),
        sections=sections,
        facts=tuple(facts(evaluation, numbers)),
        cards=tuple(cards(evaluation, numbers)),
        verdict=judge(evaluation, numbers),
    )


def _errors(evaluation: Evaluation) -> tuple[Chart, ...]:
    return (*charts.available_chart(evaluation), *charts.error_charts(evaluation))


def _filter(evaluation: Evaluation) -> tuple[Chart, ...]:
    return (*charts.innovation_chart(evaluation), *charts.clock_chart(evaluation))


def _lead(evaluation: Evaluation) -> str:
    truth = (
        f'compared with ground truth ({evaluation.run.truth_path})'
        if evaluation.run.truth is not None
        else 'without ground truth: no errors are shown'
    )
    return (
        'Thermal frames and IMU of one flight, turned into the pose of the robot in a map of acrylic markers: '
        f'from the markers alone (red) and fused with the IMU (blue), {truth}.'
    )
