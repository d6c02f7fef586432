"""Parts of the report: what a controller has, errors of the map, markers one by one, the verdict."""

from dataclasses import replace
import re

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
import pytest
from support.run_folders import (
    CAMERA_DELAY_NS,
    FUSED_DELAY_NS,
    make_run,
    run_of,
    SECONDS,
    START_NS,
    trajectory,
    wall,
)

from thermal_fiducial.cli.evaluate import print_tables
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.report.availability import at_frames, available
from thermal_fiducial.report.charts import clock_chart, error_charts, pose_charts
from thermal_fiducial.report.evaluation import evaluate
from thermal_fiducial.report.map_error import map_accuracy, marker_errors
from thermal_fiducial.report.marker_table import tags
from thermal_fiducial.report.output_bag import Arrivals, Diagnostic, RecordedOutput
from thermal_fiducial.report.picture import draw_error
from thermal_fiducial.report.run_folder import read_run
from thermal_fiducial.report.stacked_plots import TimePlots
from thermal_fiducial.report.text_table import Table
from thermal_fiducial.report.trajectory import Trajectory
from thermal_fiducial.report.verdict import HEADLINES, judge, Weight


def test_logarithmic_axes_have_whole_numbers_at_their_ticks():
    plots = TimePlots(('a', 'b', 'c', 'd'))
    time = np.arange(3.0)
    for row, values in enumerate(([0.3, np.nan, 4.0], [0.02, 1.0, 30.0], [2e-3, 1.0, 2e4], [np.nan] * 3), 1):
        plots.line(row, time, np.array(values), 'fused', 'blue')
    plots.make_logarithmic()
    shown = [axis.ticktext for axis in plots.figure.select_yaxes()]
    assert shown[0] == ('0.1', '0.2', '0.5', '1', '2', '5', '10', '20', '50')
    assert shown[1] == ('0.01', '0.03', '0.1', '0.3', '1', '3', '10', '30', '100', '300')
    assert shown[2][:3] == ('0.001', '0.01', '0.1')
    assert shown[3] is None


def test_a_wide_band_at_the_beginning_does_not_hide_the_errors(tmp_path):
    """Until map and clock offset are known, for a quarter of the time, three sigma are 60 mm and 90 ms; then 3 and 0.6.

    Errors of a millimetre, and an offset of 5 ms that is known to 0.6 ms, were a flat line in such a plot.
    """
    evaluation = evaluate(run_of(tmp_path, trajectory(200.0), trajectory(30.0)))
    stamps = evaluation.run.fused.stamps_ns[::200]
    early = np.arange(len(stamps)) < len(stamps) // 4
    covariances = np.eye(6) * np.where(early, 0.02, 0.001)[:, None, None] ** 2
    offsets = {'time offset': np.full(len(stamps), 5e-3), 'time offset std': np.where(early, 0.03, 2e-4)}
    figures = {name: (stamps, values) for name, values in (offsets | {'position std': offsets['time offset']}).items()}
    output = RecordedOutput(stamps_ns=stamps, covariances=covariances, figures=figures)
    evaluation = replace(evaluation, run=replace(evaluation.run, output=output))
    (position, _), (clock,) = error_charts(evaluation), clock_chart(evaluation)
    # A quarter more than the usual band.
    assert position.figure.layout.yaxis.range == pytest.approx((-3.75, 3.75))
    assert clock.figure.layout.yaxis.range == pytest.approx((5.0 - 0.75, 5.0 + 0.75))


def test_the_legend_of_the_summary_picture_covers_no_error(tmp_path):
    """In the lower right corner it hid the best third of the fused errors, which go on below it."""
    evaluation = evaluate(run_of(tmp_path, trajectory(200.0), trajectory(30.0)))
    figure = Figure(figsize=(4.4, 4.3))
    axis = figure.subplots()
    draw_error(axis, evaluation)
    FigureCanvasAgg(figure).draw()
    legend = axis.get_legend().get_window_extent()
    assert axis.get_ylim()[1] > axis.transData.inverted().transform((0.0, legend.y0))[1]
    for line in axis.get_lines():
        assert len(line.get_ydata())
        assert axis.transData.transform((0.0, np.nanmax(line.get_ydata())))[1] < legend.y0


# --- as available ------------------------------------------------------------------------------------


def straight(rate_hz, speed=1.5):
    stamps = START_NS + np.arange(0, round(SECONDS * 1e9), round(1e9 / rate_hz))
    t = (stamps - START_NS) * 1e-9
    return Trajectory(stamps, transform(np.tile(np.eye(3), (len(t), 1, 1)), np.outer(t, [speed, 0.0, 0.0])))


def test_the_error_of_a_held_pose_is_the_distance_flown_since(tmp_path):
    """Perfect poses in straight flight: the error as available is the speed times the age, of both."""
    fused, markers = straight(200.0), straight(30.0)
    output = RecordedOutput(
        fused_arrivals=Arrivals(fused.stamps_ns, fused.stamps_ns + FUSED_DELAY_NS),
        camera_arrivals=Arrivals(markers.stamps_ns, markers.stamps_ns + CAMERA_DELAY_NS),
    )
    run = run_of(tmp_path, fused, markers, truth=straight(100.0), output=output)
    numbers = available(run).numbers()
    for name, delay, period in (('fused', 1.0, 5.0), ('markers', 25.0, 33.3)):
        # Ages from the delay to a period more, evenly; instants every 1.7 ms see that to a fiftieth.
        ages = np.linspace(delay, delay + period, 1000)
        assert numbers['in_view'][name]['position_rms_mm'] == pytest.approx(1.5 * np.sqrt(np.mean(ages**2)), rel=0.02)
        assert numbers['age_ms'][name] == pytest.approx(delay + period / 2.0, abs=1.0)
    # At the frames' instants both are perfect, which no controller ever sees.
    assert at_frames(run)['markers']['position_rms_mm'] < 1e-6
    assert at_frames(run)['fused']['position_rms_mm'] < 1e-6


def test_arrivals_by_another_clock_count_from_the_soonest(tmp_path):
    fused, markers = straight(200.0), straight(30.0)
    apart = 7_000_000_000_000
    here, there = (
        RecordedOutput(
            fused_arrivals=Arrivals(fused.stamps_ns, fused.stamps_ns + shift),
            camera_arrivals=Arrivals(markers.stamps_ns, markers.stamps_ns + shift + CAMERA_DELAY_NS),
        )
        for shift in (0, apart)
    )
    results = [available(run_of(tmp_path, fused, markers, truth=straight(100.0), output=o)) for o in (here, there)]
    assert results[0].numbers() == results[1].numbers()


def test_without_truth_or_arrivals_there_is_no_table_of_availability(tmp_path):
    fused, markers = straight(200.0), straight(30.0)
    assert available(run_of(tmp_path, fused, markers)) is None
    output = RecordedOutput(fused_arrivals=Arrivals(fused.stamps_ns, fused.stamps_ns))
    assert available(run_of(tmp_path, fused, markers, output=output, truth=None)) is None


def test_a_run_without_poses_of_markers_has_no_table_of_availability(tmp_path):
    """Nor a warning of numpy on the way: the output is there, fiducial.tum is empty."""
    fused, markers = straight(200.0), straight(30.0)
    output = RecordedOutput(
        fused_arrivals=Arrivals(fused.stamps_ns, fused.stamps_ns),
        camera_arrivals=Arrivals(markers.stamps_ns, markers.stamps_ns),
    )
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert available(run_of(tmp_path, fused, nothing, output=output)) is None
    assert available(run_of(tmp_path, nothing, markers, output=output)) is None


# --- map and markers ---------------------------------------------------------------------------------


def moved(marker_map, d, covariance):
    """Markers that are not fixed, off by ``d`` (6,) in the convention of the covariances."""
    return MarkerMap({
        key: m if m.fixed else replace(m, covariance=covariance, T_map_marker=transform(
            so3_exp(-d[3:]) @ m.T_map_marker[:3, :3], m.T_map_marker[:3, 3] - d[:3]))
        for key, m in marker_map.markers.items()
    })  # fmt: skip


def test_errors_of_a_map():
    d = np.array([0.003, 0.0, 0.004, 0.0, 0.01, 0.0])
    estimate = moved(wall(), d, np.diag(d**2 + 1e-12))
    found = map_accuracy(estimate, wall())
    assert (found['markers'], found['not_fixed']) == (8, 7)
    assert found['position_rms_mm'] == pytest.approx(5.0)
    assert found['attitude_max_deg'] == pytest.approx(np.rad2deg(0.01))
    # Three of six degrees of freedom are one sigma off.
    assert found['nees_per_dof'] == pytest.approx(0.5, abs=1e-6)
    assert found['position_aligned_rms_mm'] < 2.0
    assert marker_errors(estimate, wall())[2].nees is None


def test_maps_without_a_common_marker_cannot_be_compared():
    with pytest.raises(InputError, match='no marker in common'):
        map_accuracy(wall(), MarkerMap())


def test_error_of_a_map_against_the_true_one(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '120')
    true = wall()
    save_map(tmp_path / 'true.yaml', true)
    marker = true.markers[5]
    T = marker.T_map_marker.copy()
    T[:3, 3] += (0.003, 0.0, 0.004)
    save_map(tmp_path / 'map.yaml', MarkerMap(true.markers | {5: replace(marker, T_map_marker=T)}))
    assert main(['map', 'error', str(tmp_path / 'map.yaml'), str(tmp_path / 'true.yaml')]) == 0
    printed = capsys.readouterr().out
    assert re.search(r'position error, largest +mm +5.00 ', printed)
    assert re.search(r'\n +5 +5\.00 +0 ', printed)
    save_map(tmp_path / 'true.yaml', replace(true, dictionary='DICT_5X5_100'))
    assert main(['map', 'error', str(tmp_path / 'map.yaml'), str(tmp_path / 'true.yaml')]) == 0
    warned = 'warning: The map has markers of DICT_4X4_50, the true one of DICT_5X5_100.'
    assert warned in capsys.readouterr().err
    save_map(tmp_path / 'other.yaml', MarkerMap({1: replace(marker, id=1)}))
    assert main(['map', 'error', str(tmp_path / 'map.yaml'), str(tmp_path / 'other.yaml')]) == 2
    assert 'no marker in common' in capsys.readouterr().err


def test_the_true_map_beside_the_truth_is_found(tmp_path):
    run = make_run(tmp_path / 'run', seconds=2.0, gap=(1.0, 1.4), with_output=False)
    assert 'map' not in evaluate(read_run(run)).numbers()
    save_map(run / 'map_true.yaml', wall())
    assert evaluate(read_run(run)).numbers()['map']['position_rms_mm'] == pytest.approx(0.0, abs=1e-6)
    assert not evaluate(read_run(run)).doubt_of_truth
    save_map(run / 'map_true.yaml', replace(wall(), dictionary='DICT_5X5_100'))
    assert evaluate(read_run(run)).doubt_of_truth.endswith('the true one of DICT_5X5_100.')


def test_markers_one_by_one_with_status_and_reason(tmp_path):
    run = read_run(make_run(tmp_path / 'run', seconds=3.0, gap=(1.0, 1.4), with_output=False))
    known = dict(run.marker_map.markers)
    known[5] = replace(known[5], trusted=False)
    del known[6], known[7]
    said = {'marker_mapper': {'quarantine': '5: 9.1 px off in 30 views; 4: gone', 'candidates': '6: too oblique'}}
    rows = tags(replace(run, marker_map=MarkerMap(known), summary={'diagnostics': said}))
    standing = {tag.id: (tag.status, tag.why) for tag in rows}
    assert standing[2] == ('fixed', 'surveyed, never moves')
    assert standing[4] == ('used', '9 observations fit')
    assert standing[5] == ('quarantined', '9.1 px off in 30 views')
    assert standing[6] == ('on trial', 'too oblique')
    assert standing[7][0] == 'not in the map'
    assert standing[9] == ('used', 'from an earlier run; not seen in this one')
    views = {tag.id: tag.views for tag in rows}
    assert views[4] == len(np.unique(run.detections.stamps_ns[run.detections.ids == 4])) > 0
    assert views[9] == 0


def test_a_marker_quarantined_while_localizing_is_not_used(tmp_path):
    """The map's file stays as it is: the table said "used", the verdict nothing, of a marker 300 mm off its place."""
    run = read_run(make_run(tmp_path / 'run', seconds=3.0, gap=(1.0, 1.4), with_output=False))
    said = {'marker_mapper': {'quarantine': '5: 9.1 px off in 30 views'}}
    evaluation = evaluate(replace(run, summary={'diagnostics': said, 'mode': 'localization'}))
    assert {tag.id: (tag.status, tag.why) for tag in evaluation.tags}[5] == ('quarantined', '9.1 px off in 30 views')
    assert 'Marker 5 contradicts the map.' in [remark.text for remark in judge(evaluation, GOOD).remarks]


@pytest.mark.parametrize('rate_hz', [50.0, 5000.0])
def test_lines_end_where_there_are_no_poses(tmp_path, rate_hz):
    """Where the filter was lost for a second a line led on, as if it had known the way."""
    every = trajectory(rate_hz)
    away = (every.stamps_ns > START_NS + 4 * 10**9) & (every.stamps_ns < START_NS + 5 * 10**9)
    evaluation = evaluate(run_of(tmp_path, every.take(~away), trajectory(30.0)))
    for chart in (*pose_charts(evaluation), *error_charts(evaluation)):
        line = next(trace for trace in chart.figure.data if trace.name == 'fused')
        ends = np.flatnonzero(np.isnan(line.y))
        assert len(ends) == 1
        assert line.x[ends[0] - 1] <= 4.0 < 4.99 < line.x[ends[0] + 1]
        assert np.all(np.diff(line.x) >= 0.0)


# --- verdict -----------------------------------------------------------------------------------------

GOOD = {
    'fused': {'poses': 900, 'rate_hz': 200.0, 'longest_pause_ms': 5.0, 'step_max_mm': 1.0},
    'innovations': {'poses': 300, 'refused': 0},
}


def with_value(numbers, path, value):
    first, *rest = path
    return numbers | {first: with_value(numbers.get(first, {}), rest, value) if rest else value}


DOUBTS = [
    (('fused', 'poses'), 0, Weight.FAULT, 'no pose'),
    (('fused', 'longest_pause_ms'), 200.0, Weight.DOUBT, 'pause of 200 ms'),
    (('fused', 'longest_pause_ms'), 900.0, Weight.FAULT, 'none for 900 ms'),
    (('fused', 'consistency', 'pose_nees_per_dof'), 3.0, Weight.DOUBT, 'claims less error'),
    (('fused', 'consistency', 'pose_nees_per_dof'), 9.0, Weight.FAULT, 'far less error'),
    (('innovations', 'refused'), 6, Weight.DOUBT, '6 of 300'),
    (('innovations', 'refused'), 60, Weight.FAULT, '60 of 300'),
    (('fused', 'step_max_mm'), 80.0, Weight.DOUBT, 'jumps by up to 80 mm'),
    (('latency', 'imu_to_pose', 'p99_ms'), 45.0, Weight.DOUBT, '45.0 ms'),
]


@pytest.mark.parametrize(('path', 'value', 'weight', 'words'), DOUBTS)
def test_what_speaks_against_a_run(tmp_path, path, value, weight, words):
    evaluation = evaluate(run_of(tmp_path, trajectory(200.0), trajectory(30.0), truth=None))
    assert judge(evaluation, GOOD).weight == Weight.NOTE  # that there is no truth
    verdict = judge(evaluation, with_value(GOOD, path, value))
    assert (verdict.weight, verdict.headline) == (weight, HEADLINES[weight])
    assert words in verdict.remarks[0].text


@pytest.mark.parametrize(('nees', 'weight'), [(0.8, Weight.GOOD), (9.0, Weight.NOTE)])
def test_nothing_speaks_for_errors_that_are_not_claimed(tmp_path, nees, weight):
    """100 mm of a camera that is elsewhere on the robot had a green tick."""
    evaluation = evaluate(run_of(tmp_path, trajectory(200.0), trajectory(30.0)))
    numbers = with_value(evaluation.numbers(), ('fused', 'consistency', 'pose_nees_per_dof'), nees)
    remarks = judge(evaluation, numbers).remarks
    assert [remark.weight for remark in remarks if 'against ground truth' in remark.text] == [weight]


def test_a_truth_of_a_part_of_the_run_says_how_much(tmp_path):
    """Errors of the seconds that a tracker had seen were those of the whole run."""
    run = run_of(tmp_path, trajectory(200.0), trajectory(30.0))
    seen = (run.truth.stamps_ns >= START_NS + 10**9) & (run.truth.stamps_ns <= START_NS + 4 * 10**9)
    evaluation = evaluate(replace(run, truth=run.truth.take(seen)))
    said = ' '.join(remark.text for remark in judge(evaluation, evaluation.numbers()).remarks)
    assert 'Errors against ground truth of the 25 % of the poses that have one: ' in said


def judged(tmp_path, *said, gap=0.0):
    """The verdict on a run without faults in which this was said: (node, level, message, count), once a second.

    Markers are out of view in the last ``gap`` [s].
    """
    diagnostics = [
        Diagnostic(*words, words[-1], tuple(START_NS + (1 + k) * 10**9 for k in range(count))) for *words, count in said
    ]
    output = RecordedOutput(diagnostics=tuple(diagnostics))
    run = run_of(tmp_path, trajectory(200.0), trajectory(30.0, SECONDS - gap), truth=None, output=output)
    return judge(evaluate(run), GOOD)


def test_what_nodes_warn_of_for_seconds_speaks_against_a_run(tmp_path):
    """A focal length 2 % too long: 62 mm off at a claim of 7 mm, and green, as nothing else shows it without truth."""
    misfit = 'marker_mapper', 'warning', 'corners are not where map and calibration have them', 5
    leaning = 'pose_ekf', 'warning', 'tracking; the map leans', 3
    assert judged(tmp_path, misfit).headline == HEADLINES[Weight.DOUBT]
    words = 'For 5 s marker_mapper warned: "corners are not where map and calibration have them" and 1 more warning.'
    assert judged(tmp_path, misfit, leaning).remarks[0].text == words


@pytest.mark.parametrize(
    'said',
    [
        ('marker_mapper', 'warning', 'quarantined: 4', 2),
        ('aruco_detector', 'ok', '8 markers', 9),
        ('aruco_detector', 'error', 'nothing on thermal/image', 9),
        ('/drone/pose_ekf', 'warning', 'coasting: 0.8 s without a pose', 9),
        ('pose_ekf', 'warning', 'tracking; pose refused: 7.1 sigma', 9),
    ],
)
def test_what_nodes_say_of_normal_operation_or_of_missing_poses_is_no_further_doubt(tmp_path, said):
    assert judged(tmp_path, said).weight == Weight.NOTE  # that there is no truth


def test_a_warning_while_no_marker_is_in_view_is_no_further_doubt(tmp_path):
    said = 'marker_mapper', 'warning', 'no known marker in view', 11
    assert 'warned' not in ' '.join(remark.text for remark in judged(tmp_path, said, gap=9.5).remarks)
    assert 'For 4 s marker_mapper warned' in ' '.join(remark.text for remark in judged(tmp_path, said, gap=7.5).remarks)


@pytest.mark.parametrize('columns', [60, 80, 200])
def test_tables_in_a_terminal_are_parted_and_lose_nothing(columns, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', str(columns))
    heads = ('marker', *(f'sigma of axis {axis} [mm]' for axis in range(12)), 'status', 'why')
    rows = [(str(marker), *(f'{marker}.{axis:03}' for axis in range(12)), 'used', 'it fits') for marker in (17, 18)]
    print_tables([Table('Markers, one by one', heads, rows)])
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= columns
    assert (shown.count('Markers, one by one') == 1) == (columns == 200)
    assert shown.count('Markers, one by one (continued)') == shown.count('Markers, one by one') - 1
    assert shown.count('[mm]') == 12
    for cell in rows[0][1:-1] + rows[1][1:-1]:
        assert cell in shown.split()
