"""The page of a report: one file without network, whose plots hold the data, read by a browser where there is one."""

import base64
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from support.run_folders import make_run

pytest.importorskip('plotly')

import plotly.graph_objects as go

from thermal_fiducial.report.page import evaluate_run, write_page
from thermal_fiducial.report.stacked_plots import FIDUCIAL, FUSED

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
CHARTS = [
    'available', 'position_error', 'attitude_error', 'scene', 'position', 'attitude', 'detections', 'innovations',
    'latency',
]  # fmt: skip


@pytest.fixture(scope='module')
def run_folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp('pages') / 'run', seconds=6.0, gap=(2.0, 3.0), shutter=(4.2, 4.7))


@pytest.fixture(scope='module')
def page(run_folder):
    return write_page(*evaluate_run(run_folder)).read_text()


def without_library(page):
    """The page but for the library of the plots, which is one script without attributes and the first."""
    begin = page.index('<script>')
    return page[:begin] + page[page.index('</script>', begin) :]


def figures(page):
    """Chart to its figure, as the page holds it."""
    found = re.findall(r'class="figure" data-chart="chart-(\w+)"[^>]*>(.*?)</script>', page, re.DOTALL)
    return {name: json.loads(text) for name, text in found}


def values(trace, axis):
    """Numbers of a trace, which are packed."""
    packed = trace[axis]
    return np.frombuffer(base64.b64decode(packed['bdata']), packed['dtype']) if isinstance(packed, dict) else packed


def test_the_page_needs_nothing_from_elsewhere(page):
    assert page.count('Plotly.newPlot') >= 1
    rest = without_library(page)
    assert not re.search(r'(src|href)="(?!#|data:)', rest)
    assert 'http' not in rest
    assert '@import' not in rest
    # The library would offer a button that uploads a plot.
    assert re.search(r"modeBarButtonsToRemove: \[[^\]]*'sendChartToCloud'", rest)
    # The library is in it once.
    assert len(page) - len(rest) > 1_000_000
    assert len(rest) < 1_500_000


def test_every_chart_has_its_place_and_its_figure(page):
    made = figures(page)
    assert list(made) == CHARTS
    for name, figure in made.items():
        assert f'id="chart-{name}"' in page
        go.Figure(figure)
        assert figure['data'], name


def test_the_plots_hold_the_run(page, run_folder):
    """Every fused pose, in the colour of the filter, at its time and place; and each pose of the markers."""
    lines = np.loadtxt(run_folder / 'fused.tum')
    traces = {(trace['name'], trace['yaxis']): trace for trace in figures(page)['position']['data'] if 'yaxis' in trace}
    x = traces['fused', 'y']
    assert x['line']['color'] == FUSED
    assert np.allclose(values(x, 'x'), lines[:, 0] - lines[0, 0], atol=1e-3)
    assert np.allclose(values(x, 'y'), lines[:, 1], atol=1e-6)
    assert traces['markers alone', 'y2']['marker']['color'] == FIDUCIAL
    assert len(values(traces['markers alone', 'y2'], 'y')) == len(np.loadtxt(run_folder / 'fiducial.tum'))
    # Three sigma as it was put in: 6 mm.
    band = next(trace for trace in figures(page)['position_error']['data'] if trace['name'] == '3 sigma of the filter')
    assert np.allclose(np.abs(values(band, 'y')), 6.0, atol=1e-3)


def test_plots_over_time_share_their_axis_and_show_why_markers_are_missing(page):
    timed = dict(re.findall(r'data-chart="chart-(\w+)" data-timed="(\w+)"', page))
    assert {name for name, value in timed.items() if value == 'no'} == {'scene'}
    for name, figure in figures(page).items():
        if timed[name] == 'no':
            continue
        axes = {key.replace('axis', ''): value for key, value in figure['layout'].items() if key.startswith('xaxis')}
        # All follow one of them.
        assert len(axes) - len([axis for axis in axes.values() if 'matches' in axis]) == 1
        assert {axis['matches'] for axis in axes.values() if 'matches' in axis} <= axes.keys()
        shown = {trace['name'] for trace in figure['data']}
        assert {'shutter (FFC)', 'no marker in view'} <= shown
        assert len([shape for shape in figure['layout']['shapes'] if shape['xref'] == 'x']) == 2


def test_space_holds_path_markers_and_ellipsoids(page):
    traces = {trace.get('name'): trace for trace in figures(page)['scene']['data']}
    assert {'ground truth', 'fused', 'marker fixed', 'marker seen', 'marker not seen'} <= traces.keys()
    assert len(values(traces['marker seen'], 'x')) == 4 * 6
    labels = [text for trace in figures(page)['scene']['data'] for text in trace.get('text', [])]
    assert sorted(labels, key=int) == [str(marker) for marker in range(2, 10)]
    # Of 16 poses, each an ellipsoid of 2 mm times three sigma times the factor that the text names.
    factor = float(re.search(r'enlarged (\d+) times', page)[1])
    ball, path = traces['uncertainty of the pose'], traces['fused']
    x = values(ball, 'x').reshape(16, -1)
    assert np.allclose(np.ptp(x, axis=1), 2 * 3 * 0.002 * factor, rtol=0.02)
    assert values(path, 'x').min() < x.mean() < values(path, 'x').max()


def test_the_overview_states_its_verdicts_in_sentences(page):
    overview = page[page.index('class="verdict') : page.index('<section id="errors"')]
    for words in (
        'can be flown on, with reservations',
        '1 shutter event, the longest 0.5 s',
        '1 drop-out of up to 1.0 s (no marker in view)',
        'The covariance is consistent',
        'as available while markers are in view; markers alone',
        'of 180 camera poses were refused',
    ):
        assert words in overview, words


def test_units_stand_in_every_table(page):
    tables = re.findall(r'<table>.*?</table>', page, re.DOTALL)
    assert len(tables) >= 9
    for table in tables:
        title = re.search(r'<caption>(.*?)</caption>', table)[1]
        heads = re.findall(r'<th[^>]*>(.*?)</th>', table)
        units = 'unit' in heads or any('[' in head for head in heads)
        assert units, title


def test_figures_of_the_diagnostics_are_not_shown_beside_those_of_all_poses(run_folder):
    """What the nodes say of their latest poses must not stand beside the figures of all, under the same names."""
    summary = json.loads((run_folder / 'summary.json').read_text())
    said = {
        'pose_ekf': {
            'poses refused': '7',
            'NIS per d.o.f.': '0.81',
            'position std': '0.004',
            'mount vibration': '1e-05',
        }
    }
    (run_folder / 'summary.json').write_text(json.dumps(summary | {'diagnostics': said}))
    evaluation, numbers = evaluate_run(run_folder)
    page = without_library(write_page(evaluation, numbers).read_text())
    (run_folder / 'summary.json').write_text(json.dumps(summary))
    assert '0.81' not in page
    assert (
        f'of these, refused: beyond the gate</td><td class="text">count</td><td>{numbers["innovations"]["refused"]}'
        in page
    )
    assert 'position std</td><td class="text">0.004</td><td class="text">m</td>' in page
    assert 'mount vibration</td><td class="text">0.00001</td><td class="text">rad</td>' in page


def test_without_truth_there_are_no_errors_rather_than_false_ones(tmp_path):
    run = make_run(tmp_path / 'run', seconds=3.0, gap=(1.0, 1.5), with_output=False, with_truth=False)
    (run / 'latency.csv').unlink()
    page = write_page(*evaluate_run(run)).read_text()
    assert 'without ground truth' in page
    assert 'how large the errors are is not known' in page
    assert list(figures(page)) == ['scene', 'position', 'attitude', 'detections']
    assert 'osition error' not in without_library(page)


PHONE = r"""<iframe id="phone" width="390" height="844" src="report.html"></iframe>
<script>
const frame = document.getElementById('phone');
frame.onload = () => {
  const page = frame.contentDocument;
  const wide = [...page.querySelectorAll('.scroll:not(.wide)')].filter((part) => part.scrollWidth > part.clientWidth);
  document.body.dataset.width = page.documentElement.scrollWidth;
  document.body.dataset.wide = wide.map((part) => part.querySelector('caption').textContent).join('|');
  const lines = (cell) => {
    const range = page.createRange();
    range.selectNodeContents(cell);
    return range.getClientRects().length;
  };
  const words = [...page.querySelectorAll('td')].filter((cell) => /^[a-z]{1,9}$|Hz\)$/.test(cell.textContent));
  const broken = words.filter((cell) => lines(cell) > 1);
  document.body.dataset.broken = broken.map((cell) => cell.textContent).join('|');
};
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason='no chromium')
def test_nothing_is_wider_than_a_phone(run_folder, tmp_path):
    """The page with its paths, and all tables but those of many columns, which can be moved under the first one."""
    run = shutil.copytree(run_folder, tmp_path / ('a_run_folder_with_a_long_name' * 2))
    said = {'gyroscope noise under vibration': '0.000153832', 'accelerometer noise under vibration': '0.001813'}
    said = {'pose_ekf': said | {'seconds since accepted pose': '2.4728e-05', 'expected rate [Hz]': '200 (160 to 240)'}}
    (run / 'summary.json').write_text(
        json.dumps(json.loads((run / 'summary.json').read_text()) | {'diagnostics': said})
    )
    page = without_library(write_page(*evaluate_run(run)).read_text())
    assert '>m/s^2/sqrt(Hz)<' in page
    assert run.name in page
    (tmp_path / 'report.html').write_text(re.sub(r'<script>.*?</script>', '', page, flags=re.DOTALL))
    (tmp_path / 'phone.html').write_text(PHONE)
    command = [
        CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', '--no-first-run', '--allow-file-access-from-files',
        f'--user-data-dir={tmp_path / "browser"}', '--virtual-time-budget=5000', '--dump-dom',
        (tmp_path / 'phone.html').as_uri(),
    ]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False).stdout
    found = re.search(r'<body[^>]*data-width="(\d+)" data-wide="([^"]*)" data-broken="([^"]*)"', dom)
    assert found, dom[-2000:]
    # The width of the frame.
    assert int(found[1]) <= 390
    assert found[2] == ''
    # Units and other short words stay on one line.
    assert found[3] == ''


#: Goes to places of a page and notes which entry of its navigation is marked: at the top, at a section, at the figures
#: behind the header, at the end.
READER = """<script>
window.onload = () => {
  const places = [() => 0, () => from('#pose'), () => from('.cards'), () => document.body.scrollHeight];
  const from = (part) => document.querySelector(part).getBoundingClientRect().top + scrollY - 60;
  const marked = [];
  for (const place of places) {
    scrollTo({ top: place(), behavior: 'instant' });
    // A browser without a window draws no frames, with which the event would come.
    window.dispatchEvent(new Event('scroll'));
    marked.push([...document.querySelectorAll('nav a.here')].map((link) => link.textContent).join('+'));
  }
  document.body.dataset.marked = marked.join();
};
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason='no chromium')
@pytest.mark.parametrize(
    ('height', 'marked'), [(800, 'Overview,Pose,Overview,Nodes'), (20_000, 'Overview,Overview,Overview,Overview')]
)
def test_the_navigation_marks_where_one_reads(run_folder, tmp_path, height, marked):
    """In a window, and in one that shows the whole page; without the plots, which the places do not need."""
    run = shutil.copytree(run_folder, tmp_path / 'run')
    said = {'pose_ekf': {'seconds since accepted pose': '2.4728e-05'}}
    (run / 'summary.json').write_text(
        json.dumps(json.loads((run / 'summary.json').read_text()) | {'diagnostics': said})
    )
    page = without_library(write_page(*evaluate_run(run)).read_text())
    (tmp_path / 'report.html').write_text(page.replace('</body>', READER + '</body>'))
    command = [
        CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', '--no-first-run',
        f'--user-data-dir={tmp_path / "browser"}', f'--window-size=1300,{height}', '--virtual-time-budget=5000',
        '--dump-dom', (tmp_path / 'report.html').as_uri(),
    ]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False).stdout
    found = re.search(r'<body[^>]*data-marked="([^"]*)"', dom)
    assert found, dom[-2000:]
    assert found[1] == marked


def test_dots_of_a_legend_are_large_enough_to_show_their_colour(page):
    """Dots of 3.5 pixels, as in the plots, looked alike in red, blue and violet."""
    for figure in figures(page).values():
        assert figure['layout']['legend']['itemsizing'] == 'constant'


def test_a_number_and_its_percent_sign_are_not_parted(page):
    cells = [cell for cell in re.findall(r'<td[^>]*>([^<]*)</td>', page) if '%' in cell]
    assert cells
    assert not [cell for cell in cells if ' %' in cell]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason='no chromium')
def test_a_browser_draws_every_chart(run_folder, tmp_path):
    """Without a graphics card, as CI has none: the view in space may stay empty, all else is drawn."""
    path = write_page(*evaluate_run(run_folder))
    command = [
        CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', '--disable-3d-apis', '--no-first-run',
        f'--user-data-dir={tmp_path}', '--window-size=1300,1000', '--virtual-time-budget=10000', '--dump-dom',
        path.resolve().as_uri(),
    ]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False).stdout
    drawn = re.search(r'<body[^>]*data-drawn="(\d+)"', dom)
    assert drawn, dom[-2000:]
    assert int(drawn[1]) == len(CHARTS)
    assert 'Share chart' not in dom[dom.index('<body') : dom.index('<script>')]
    for name in set(CHARTS) - {'scene'}:
        place = dom.index(f'id="chart-{name}"')
        assert '<svg class="main-svg"' in dom[place : place + 3000], name
