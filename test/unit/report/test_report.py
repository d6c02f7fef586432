"""The report on a run folder: what it reads, what it refuses, what it shows."""

from dataclasses import replace
from decimal import Decimal
import json

import numpy as np
import pytest
from support.run_folders import FIDUCIAL_SIGMA, FUSED_SIGMA, make_run, run_of, trajectory, wall, write_truth_bag
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import so3_exp
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.files.trajectory_file import load_tum, save_tum
from thermal_fiducial.report.evaluation import evaluate
from thermal_fiducial.report.metrics import errors, other_unit
from thermal_fiducial.report.overview import cards
from thermal_fiducial.report.page import evaluate_run, write_page
from thermal_fiducial.report.run_folder import read_run
from thermal_fiducial.report.tables import tables
from thermal_fiducial.report.text_table import number
from thermal_fiducial.report.trajectory import Trajectory
from thermal_fiducial.report.verdict import judge, Weight

pytest.importorskip('plotly')

from thermal_fiducial.report.charts import euler_deg, near, visible_spans
from thermal_fiducial.report.stacked_plots import thinned


@pytest.fixture(scope='module')
def run_folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp('runs') / 'run')


@pytest.fixture
def small_run(tmp_path):
    return make_run(tmp_path / 'run', seconds=3.0, gap=(1.0, 1.5), with_output=False)


def test_the_measures_are_those_of_the_noise_that_was_put_in(run_folder):
    numbers = evaluate_run(run_folder)[1]
    for name, sigma, tolerance in (('fused', FUSED_SIGMA, 0.04), ('fiducial', FIDUCIAL_SIGMA, 0.1)):
        # rms of three axes of white noise from 4000 and 541 poses: the tolerances are four sigma of that estimate.
        error = numbers[name]['error']
        assert error['position_rms_mm'] == pytest.approx(1e3 * np.sqrt(3) * sigma[0], rel=tolerance)
        assert error['attitude_rms_deg'] == pytest.approx(np.rad2deg(np.sqrt(3) * sigma[3]), rel=tolerance)
        assert numbers[name]['jitter']['position_mm'] == pytest.approx(1e3 * np.sqrt(6) * sigma[0], rel=1.2 * tolerance)
    # 200 samples of six degrees of freedom: the mean's sigma is sqrt(2 / 1200) = 4 %.
    assert numbers['fused']['consistency']['pose_nees_per_dof'] == pytest.approx(1.0, abs=0.16)
    innovations = numbers['innovations']
    assert (innovations['poses'], innovations['refused']) == (600, 20)
    # 580 samples of six degrees of freedom: sigma sqrt(2 / 3480) = 2.4 %, and sqrt(.95 * .05 / 580) = 0.9 %; four of it
    assert innovations['nis_per_dof'] == pytest.approx(1.0, abs=0.1)
    assert innovations['within_95'] == pytest.approx(0.95, abs=0.036)
    assert numbers['latency']['imu_to_pose']['p50_ms'] == pytest.approx(2.0, abs=0.1)
    assert numbers['markers'] == {
        'detections': 2450,
        'frames_with_markers': 526,
        'seen_in_a_frame': pytest.approx(2450 / 526),
        'different': 7,
        'corner_sigma_median_px': 0.03,
        'in_map': 8,
        'detections_not_in_map': 0,
    }
    drop_out, shutter = numbers['interruptions']
    assert (drop_out['cause'], shutter['cause']) == ('no marker in view', 'shutter (FFC)')
    assert drop_out['seconds'] == pytest.approx(2.0, abs=0.07)
    assert shutter['seconds'] == pytest.approx(0.5, abs=0.07)


def test_the_measures_are_added_to_the_summary(run_folder):
    evaluate_run(run_folder)
    evaluate_run(run_folder)
    summary = json.loads((run_folder / 'summary.json').read_text())
    assert summary['bag'] == 'made_up'
    assert summary['evaluation']['fused']['error']['position_rms_mm'] > 0.0


def test_the_camera_s_clock_is_no_error_of_the_fiducial_poses(small_run):
    """Stamps 25 ms early, and the filter was given that: the same errors as with right stamps."""
    right = evaluate_run(small_run)[1]['fiducial']['error']['position_rms_mm']
    lines = [line.split(' ', 1) for line in (small_run / 'fiducial.tum').read_text().splitlines()]
    early = [f'{Decimal(stamp) - Decimal("0.025")} {rest}\n' for stamp, rest in lines]
    (small_run / 'fiducial.tum').write_text(''.join(early))
    wrong = evaluate_run(small_run)[1]['fiducial']['error']['position_rms_mm']
    parameters = {'/pose_ekf': {'ros__parameters': {'camera_time_offset': 0.025}}}
    (small_run / 'parameters.yaml').write_text(yaml.safe_dump(parameters))
    assert evaluate_run(small_run)[1]['fiducial']['error']['position_rms_mm'] == pytest.approx(right)
    assert wrong > right + 1.0


def test_truth_from_a_bag_is_the_truth_from_a_file(tmp_path, small_run):
    from_file = evaluate_run(small_run)[1]
    (small_run / 'truth.tum').unlink()
    without = evaluate_run(small_run)[1]
    from_bag = evaluate_run(small_run, write_truth_bag(tmp_path / 'bag', 3.0))[1]
    assert 'error' not in without['fused']
    # The file rounds to a nanometre.
    assert from_bag['fused']['error'] == pytest.approx(from_file['fused']['error'], rel=1e-5)


def test_the_same_run_gives_the_same_page(small_run):
    assert write_page(*evaluate_run(small_run)).read_bytes() == write_page(*evaluate_run(small_run)).read_bytes()


def test_words_of_others_are_escaped(small_run):
    (small_run / 'summary.json').write_text(json.dumps({'bag': '<script>alert(1)</script>'}))
    assert '<script>alert' not in write_page(*evaluate_run(small_run)).read_text()


@pytest.mark.parametrize('kept', [('fused.tum', 'fiducial.tum'), ('fused.tum', 'fiducial.tum', 'detections.csv')])
def test_a_bare_run_has_a_report(small_run, kept):
    for path in small_run.iterdir():
        if path.name not in kept:
            path.unlink()
    assert 'id="chart-detections"' in write_page(*evaluate_run(small_run)).read_text()


def test_a_run_in_which_nothing_came_out_has_a_report(tmp_path):
    for name in ('fused.tum', 'fiducial.tum'):
        (tmp_path / name).touch()
    (tmp_path / 'detections.csv').write_text('stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3,sigma_px\n')
    evaluation, numbers = evaluate_run(tmp_path)
    assert numbers['fused'] == {'poses': 0}
    assert [card.name for card in cards(evaluation, numbers)] == ['Output', 'Markers']
    assert write_page(*evaluate_run(tmp_path)).is_file()


def test_a_run_whose_map_stayed_empty_has_a_report(small_run):
    save_map(small_run / 'map_true.yaml', wall())
    save_map(small_run / 'marker_map.yaml', MarkerMap())
    assert 'map' not in evaluate_run(small_run)[1]
    assert write_page(*evaluate_run(small_run)).is_file()


@pytest.mark.parametrize(('fixed', 'words'), [((2,), 'rms of 7 markers'), (range(2, 10), 'rms of 8 fixed markers')])
def test_error_of_the_map_says_of_how_many_markers(small_run, fixed, words):
    for name in ('map_true.yaml', 'marker_map.yaml'):
        markers = wall().markers
        save_map(small_run / name, MarkerMap({key: replace(m, fixed=key in fixed) for key, m in markers.items()}))
    evaluation, numbers = evaluate_run(small_run)
    assert next(card.note for card in cards(evaluation, numbers) if card.name == 'Map error') == words


def test_diagnostics_count_in_the_clock_of_the_bag(tmp_path):
    """Nodes in processes of their own stamp them with the wall clock, three years after this flight."""
    run = make_run(tmp_path / 'run', seconds=6.0, gap=(2.0, 3.0), shutter=(4.2, 4.7), said_by_ns=10**17)
    evaluation, _ = evaluate_run(run)
    assert [entry.is_shutter for entry in evaluation.interruptions] == [False, True]
    times = [times for times, _ in evaluation.run.output.figures.values()]
    times.append(np.array([time_ns for time_ns, _ in evaluation.run.output.withheld]))
    assert len(np.concatenate(times))
    assert np.abs(evaluation.seconds(np.concatenate(times))).max() < 10.0


def test_one_shutter_event_is_one_event(run_folder):
    evaluation, numbers = evaluate_run(run_folder)
    shutter = next(card for card in cards(evaluation, numbers) if card.name == 'Shutter (FFC)')
    assert (shutter.value, shutter.unit) == ('1', 'event')


def test_a_fused_path_without_any_fiducial_pose(small_run):
    (small_run / 'fiducial.tum').write_text('')
    numbers = evaluate_run(small_run)[1]
    assert numbers['fiducial'] == {'poses': 0, 'path_length_m': 0.0}
    assert write_page(*evaluate_run(small_run)).is_file()


# --- bad input -----------------------------------------------------------------------------------------

BROKEN = [
    ('fused.tum', '1.0 2.0 3.0\n', 'fused.tum'),
    ('fiducial.tum', 'a b c d e f g h\n', 'fiducial.tum'),
    ('fused.tum', '2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n', 'goes back'),
    ('fused.tum', '2.0 0 0 0 0 0 0 nan\n', 'fused.tum'),
    ('detections.csv', 'stamp_ns,id\n1,2\n', 'detections.csv: line 1'),
    ('latency.csv', 'kind,stamp_ns,latency_ms\nimu_to_pose,1,slow\n', 'latency.csv, line 2'),
    ('summary.json', '{"bag": ', 'summary.json'),
    ('summary.json', '[1]', 'not a JSON object'),
    ('parameters.yaml', '/pose_ekf: 3\n', 'parameters.yaml'),
    ('marker_map.yaml', 'markers: 3\n', 'marker_map.yaml'),
    ('truth.tum', '1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n', 'it is from 1.0 to 2.0 s, the run is from '),
]


@pytest.mark.parametrize(('name', 'text', 'words'), BROKEN, ids=lambda value: None)
def test_a_broken_file_gives_one_line_and_status_2(small_run, capsys, name, text, words):
    (small_run / name).write_text(text)
    assert main(['evaluate', str(small_run)]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count('\n') == 1


def test_a_damaged_output_bag_gives_one_line(small_run, capsys):
    (small_run / 'output').mkdir()
    (small_run / 'output' / 'metadata.yaml').write_text('rosbag2_bagfile_information: 7\n')
    assert main(['evaluate', str(small_run)]) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.parametrize('make', [lambda path: None, lambda path: path.mkdir(), lambda path: path.touch()])
def test_what_is_no_run_folder_is_refused(tmp_path, capsys, make):
    make(tmp_path / 'run')
    assert main(['evaluate', str(tmp_path / 'run')]) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.parametrize('truth', ['none.tum', 'empty.tum', 'folder', 'text.mcap'])
def test_unusable_truth_is_refused(tmp_path, small_run, capsys, truth):
    (tmp_path / 'empty.tum').touch()
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'text.mcap').write_text('no bag')
    assert main(['evaluate', str(small_run), '--truth', str(tmp_path / truth)]) == 2
    error = capsys.readouterr().err
    assert truth in error
    assert error.count('\n') == 1


def test_truth_that_is_too_sparse_is_not_called_one_of_another_time(small_run, capsys):
    """Of a tracker at 2 Hz, say: both spans were named, and they were the same."""
    truth = small_run / 'truth.tum'
    truth.write_text('\n'.join(truth.read_text().splitlines()[::50]) + '\n')
    assert main(['evaluate', str(small_run)]) == 2
    error = capsys.readouterr().err
    assert 'poses of the ground truth are more than 0.2 s apart' in error
    assert 'no time in common' not in error


@pytest.mark.parametrize(('unit', 'count'), [('millimetres', 1000), ('centimetres', 100)])
def test_truth_that_is_not_in_metres_is_refused(small_run, capsys, unit, count):
    """Of a tracker that writes millimetres: the errors were those of the unit, and nothing said so."""
    truth = small_run / 'truth.tum'
    stamps, positions, quaternions = load_tum(truth)
    # The tracker's axes need not be those of the map.
    save_tum(truth, stamps.tolist(), count * (positions[:, [1, 2, 0]] + 3.0), quaternions)
    assert main(['evaluate', str(small_run)]) == 2
    error = capsys.readouterr().err
    assert f'{truth}: positions of the ground truth are {count} times those of run {small_run}' in error
    assert f'they seem to be in {unit}, and must be in metres' in error


@pytest.mark.parametrize('scale', [0.0, 1e-4, 0.3, 1.0, 3.0, 100.0])
def test_a_bad_run_is_not_a_truth_in_another_unit(scale):
    """Whether it stands or flies off."""
    truth = trajectory(100.0)
    poses = truth.T_map_body.copy()
    poses[:, :3, 3] *= scale
    assert other_unit(errors(Trajectory(truth.stamps_ns, poses), truth)) == ('', 1.0)


def test_truth_with_w_before_x_y_z_is_named(small_run, capsys):
    """The attitude was 179 deg off, and nothing said why."""
    truth = small_run / 'truth.tum'
    stamps, positions, quaternions = load_tum(truth)
    save_tum(truth, stamps.tolist(), positions, np.roll(quaternions, 1, axis=1))
    assert main(['evaluate', str(small_run)]) == 0
    said = 'with the quaternions of the ground truth as w x y z: they must be x y z w.'
    assert said in capsys.readouterr().err
    assert any(said in remark.text for remark in judge(*evaluate_run(small_run)).remarks)


@pytest.mark.parametrize('offset_s', [-1.234, 0.15, 0.3])
def test_truth_of_another_clock_is_named_with_what_is_to_be_added(small_run, capsys, offset_s):
    """A tracker 0.3 s off made errors of 94 mm, and a covariance at fault, of a run that was 0.4 mm off."""
    truth = small_run / 'truth.tum'
    stamps, positions, quaternions = load_tum(truth)
    # In a frame of its own as well, as trackers have.
    turn = so3_exp(np.array([0.0, 0.0, 0.3]))
    save_tum(truth, (stamps - round(offset_s * 1e9)).tolist(), positions @ turn.T + [5.0, 0.0, 1.0], quaternions)
    assert main(['evaluate', str(small_run)]) == 0
    said = capsys.readouterr().err.partition('With ')[2]
    # In steps of a millisecond; the noise of the run, 2 mm at 0.7 m/s, moves the best one by another.
    assert abs(float(said.partition(' s added')[0]) - offset_s) < 2.5e-3
    assert said.endswith('mm off, after rigid alignment: its clock is not that of the IMU.\n')


@pytest.mark.parametrize('scale', [0.0, 1e-4, 0.3, 1.0])
def test_a_bad_run_is_not_a_truth_of_another_clock(tmp_path, scale):
    """Whether it stands, or flies paths that are too short, or is late by as much as synchronised clocks are apart."""
    truth = trajectory(100.0)
    poses = truth.T_map_body.copy()
    poses[:, :3, 3] *= scale
    late = Trajectory(truth.stamps_ns + 4_000_000, poses)
    assert evaluate(run_of(tmp_path, late, late, truth=truth)).doubt_of_truth == ''


@pytest.mark.parametrize('turn_deg', [0.0, 3.0, 90.0, 120.0, 180.0])
@pytest.mark.parametrize('axis', [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.577, 0.577, 0.577)])
def test_a_run_with_a_wrong_attitude_is_not_a_truth_in_another_order(tmp_path, turn_deg, axis):
    """As one whose camera_orientation is wrong."""
    truth = trajectory(100.0)
    poses = truth.T_map_body.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp(np.deg2rad(turn_deg) * np.array(axis))
    turned = Trajectory(truth.stamps_ns, poses)
    assert evaluate(run_of(tmp_path, turned, turned)).doubt_of_truth == ''


@pytest.mark.parametrize(('count', 'words'), [(0, 'no pose'), (1, '1 pose'), (2, '2 poses')])
def test_a_run_of_hardly_any_pose_says_how_many_it_has(small_run, count, words):
    fused = small_run / 'fused.tum'
    fused.write_text(''.join(fused.read_text().splitlines(keepends=True)[:count]))
    remark = judge(*evaluate_run(small_run)).remarks[0]
    assert (remark.weight, remark.text) == (Weight.FAULT, f'The filter gave {words}.')


@pytest.mark.parametrize('replayed', ['bag', 'bag/bag_0.mcap'])
def test_the_truth_in_the_bag_that_was_replayed_is_used_and_named(tmp_path, small_run, capsys, replayed):
    """Also where a single file of the bag was replayed, beside which the truth lies."""
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / 'bag_0.mcap').touch()
    (small_run / 'truth.tum').rename(bag / 'ground_truth.tum')
    place = tmp_path / replayed
    (small_run / 'summary.json').write_text(json.dumps({'bag': place.name, 'bag_path': str(place)}))
    assert main(['evaluate', str(small_run), '--no-report']) == 0
    printed = capsys.readouterr().out
    assert f'ground truth: {bag / "ground_truth.tum"}' in printed
    assert 'position_rms_mm' in json.loads((small_run / 'summary.json').read_text())['evaluation']['fused']['error']
    (bag / 'ground_truth.tum').write_text('5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n')
    assert main(['evaluate', str(small_run)]) == 2
    assert f'{bag / "ground_truth.tum"}: ground truth and run' in capsys.readouterr().err


def test_a_replay_that_was_cut_short_is_no_run(small_run, capsys):
    (small_run / 'fused.tum').rename(small_run / 'fused.tum.part')
    assert main(['evaluate', str(small_run)]) == 2
    assert capsys.readouterr().err.strip().endswith(f'{small_run}: its replay was cut short; replay it again')


def test_a_bag_without_truth_is_refused_by_the_name_of_the_topic(run_folder, capsys):
    assert main(['evaluate', str(run_folder), '--truth', str(run_folder / 'output')]) == 2
    assert 'ground_truth/odometry' in capsys.readouterr().err


def test_a_report_that_cannot_be_written_is_an_input_error(small_run):
    (small_run / 'report.html').mkdir()
    with pytest.raises(InputError, match=r'report\.html'):
        write_page(*evaluate_run(small_run))


# --- command -------------------------------------------------------------------------------------------


def test_evaluate_prints_tables_with_their_units(small_run, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '200')
    assert main(['evaluate', str(small_run)]) == 0
    printed = capsys.readouterr().out
    for words in ('position error, rms', 'markers alone', 'mm', 'no marker in view', 'report.html'):
        assert words in printed


def test_evaluate_prints_json(small_run, capsys):
    assert main(['evaluate', str(small_run), '--json', '--no-report']) == 0
    assert json.loads(capsys.readouterr().out)['fused']['poses'] == 600
    assert not (small_run / 'report.html').exists()


# --- parts ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('value', 'text'),
    [(0.0, '0'), (None, '–'), (1234.5, '1234'), (0.05604, '0.0560'), (22.04, '22.0'), (200.0, '200'), (5962, '5962'),
     (3.14159, '3.14'), (12345678.0, '12345678'),
     (1.2e-5, '0.000012'), (-2.5, '-2.50'), (1e-9, '0')],
)  # fmt: skip
def test_numbers_are_written_plainly(value, text):
    assert number(value) == text


def test_angles_do_not_jump():
    yaw = np.deg2rad(np.linspace(0.0, 720.0, 100))
    T = np.tile(np.eye(4), (100, 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
    T[:, 1, 0], T[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    assert np.allclose(euler_deg(T)[:, 2], np.rad2deg(yaw))
    assert np.allclose(near(np.array([[0.0, 0.0, -359.0]]), np.array([0.0, 0.0, 2.0])), [[0.0, 0.0, 1.0]])


def test_thinning_keeps_both_ends():
    assert thinned(0).tolist() == []
    assert thinned(3).tolist() == [0, 1, 2]
    index = thinned(100_000, 100)
    assert (len(index), index[0], index[-1]) == (100, 0, 99_999)


def test_visible_spans_break_at_gaps():
    stamps = np.array([0, 33, 66, 1000, 1033]) * 1_000_000
    assert visible_spans(stamps) == [(0, 66_000_000), (1_000_000_000, 1_033_000_000)]
    assert visible_spans(stamps[:0]) == []


def test_tables_omit_unknown_values(small_run):
    evaluation = evaluate(read_run(small_run))
    made = tables(evaluation, evaluation.numbers())
    assert {'accuracy', 'at_frames', 'tags'} <= made.keys()
    assert not {'pilot', 'consistency', 'innovations', 'map', 'diagnostics'} & made.keys()
    assert not any(name.startswith('figures') for name in made)


def test_messages_of_nodes_are_counted_regardless_of_their_numbers(run_folder):
    said = {(entry.node, entry.level, entry.message): entry.count for entry in read_run(run_folder).output.diagnostics}
    assert said == {
        ('pose_ekf', 'ok', 'running for N s'): 20,
        ('tau2_camera', 'warning', 'FFC'): 20,
    }


def test_figures_and_load_of_the_nodes(small_run):
    counted = {'withheld: FFC': '12', 'refused messages': '0', 'received /thermal/image_raw': '9'}
    rates = {
        'rate /thermal/image_raw [Hz]': '29.9',
        'accelerometer noise under vibration': '0.00181305',
        'map tilt': '9.17798e-06',
    }
    diagnostics = {'tau2_camera': counted | rates, 'pose_ekf': {'resets': '0', 'in view': '2, 3'}}
    (small_run / 'summary.json').write_text(
        json.dumps({'diagnostics': diagnostics, 'cpu_percent': {'pose_ekf': 24.04}})
    )
    evaluation = evaluate(read_run(small_run))
    made = tables(evaluation, evaluation.numbers())
    assert made['figures of tau2_camera'].rows == [
        ('withheld: FFC', '12', 'count'),
        ('rate /thermal/image_raw', '29.9', 'Hz'),
        ('accelerometer noise under vibration', '0.001813', 'm/s^2/sqrt(Hz)'),
        ('map tilt', '0.000009', 'rad'),
    ]
    assert made['figures of pose_ekf'].rows == [('in view', '2, 3', '')]
    assert made['load'].rows == [('pose_ekf', '24.0')]
