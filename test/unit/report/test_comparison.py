"""Runs side by side: the numbers are evo's, and agree with ours where truth has the same stamps."""

from dataclasses import replace
import json
from shutil import copytree

import pytest
from support.run_folders import make_run

from thermal_fiducial.cli.main import main
from thermal_fiducial.report.page import evaluate_run

pytest.importorskip('evo')

from evo import main_ape, main_rpe
from evo.core.metrics import PoseRelation, Unit
from evo.core.sync import associate_trajectories
from evo.tools.file_interface import read_tum_trajectory_file

from thermal_fiducial.report.comparison import compare


@pytest.fixture(scope='module')
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp('compared')
    return [make_run(folder / name, 4.0, seed, (1.0, 1.5), with_output=False) for name, seed in (('a', 0), ('b', 1))]


@pytest.fixture(scope='module')
def comparison(runs):
    return compare(runs)


CASES = {
    'ape_translation': (main_ape.ape, PoseRelation.translation_part, {}, 1e3),
    'ape_translation_aligned': (main_ape.ape, PoseRelation.translation_part, {'align': True}, 1e3),
    'ape_rotation': (main_ape.ape, PoseRelation.rotation_angle_deg, {}, 1.0),
    'rpe_translation': (main_rpe.rpe, PoseRelation.translation_part, {'delta': 1.0, 'delta_unit': Unit.meters}, 1e3),
}


@pytest.mark.parametrize('name', CASES)
def test_the_numbers_are_those_of_evo_s_own_programs(runs, comparison, name):
    program, relation, options, scale = CASES[name]
    truth, fused = (read_tum_trajectory_file(str(runs[1] / file)) for file in ('truth.tum', 'fused.tum'))
    truth, fused = associate_trajectories(truth, fused, max_diff=0.01)
    expected = program(truth, fused, relation, **options).stats
    found = comparison.numbers['b']['evo'][name]
    for statistic, value in found.items():
        # evo reads stamps and quaternions from the file as we do, to rounding.
        assert value == pytest.approx(scale * expected[statistic], rel=1e-6, abs=1e-6), statistic


def test_they_agree_with_the_report_of_each_run(runs, comparison):
    """Truth at 100 Hz, poses at 200: evo takes the nearest true pose, the report interpolates."""
    for name, run in zip('ab', runs, strict=True):
        error = evaluate_run(run)[1]['fused']['error']
        found = comparison.numbers[name]['evo']
        # Pairs of the 5 ms between: 0.6 m/s make 3 mm in each second pose, which evo does not pair (one to one).
        assert found['ape_translation']['rmse'] == pytest.approx(error['position_rms_mm'], rel=0.05)
        assert found['ape_rotation']['rmse'] == pytest.approx(error['attitude_rms_deg'], rel=0.05)


def test_the_page_and_the_tables(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '120')
    page = tmp_path / 'comparison.html'
    assert main(['evaluate', *map(str, runs), '--compare', '--out', str(page)]) == 0
    printed = capsys.readouterr().out
    for words in ('APE, translation, not aligned', 'rmse', 'mm', 'path length', str(page)):
        assert words in printed
    text = page.read_text()
    assert 'id="chart-errors"' in text
    assert '<th scope="col">a</th><th scope="col">b</th>' in text
    assert main(['evaluate', *map(str, runs), '--compare', '--json', '--no-report']) == 0
    assert json.loads(capsys.readouterr().out).keys() == {'a', 'b'}
    assert main(['evaluate', *map(str, runs), '--compare', '--json', '--out', str(page)]) == 0
    assert json.loads(capsys.readouterr().out).keys() == {'a', 'b'}


def test_counts_have_no_decimals(comparison):
    counted = {
        name: values | {'innovations': {'poses': 90, 'refused': 16}} for name, values in comparison.numbers.items()
    }
    of_filter = replace(comparison, numbers=counted).tables[-1]
    assert ('of these, refused', 'count', '16', '16') in of_filter.rows


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['a', 'b'], '--compare'),
        (['a', '--compare'], 'two runs or more'),
        (['a', 'a', '--compare'], 'given twice'),
        (['a', 'b', '--compare', '--video'], '--video has no effect with --compare'),
    ],
)
def test_what_cannot_be_compared(runs, capsys, arguments, words):
    folder = runs[0].parent
    assert main(['evaluate', *(str(folder / word) if len(word) == 1 else word for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count('\n') == 1


def test_a_run_without_truth_is_marked_so(runs, tmp_path, capsys):
    blind = make_run(tmp_path / 'blind', 2.0, 0, (1.0, 1.4), with_output=False)
    (blind / 'truth.tum').unlink()
    page = tmp_path / 'comparison.html'
    assert main(['evaluate', str(runs[0]), str(blind), '--compare', '--out', str(page)]) == 0
    line = (
        'No errors of blind: no ground truth at their stamps (--truth names one for all, truth.tum in a run folder one '
        'for that run).'
    )
    assert line in capsys.readouterr().out.replace('\n', ' ')
    assert line in page.read_text()
    # A comparison has no overview to lead to.
    assert 'Overview' not in page.read_text()


def test_a_run_of_a_robot_at_rest_has_errors_though_nothing_aligns_it(runs, tmp_path):
    """Poses in a point or on a line may turn about it."""
    folder = tmp_path / 'rest'
    copytree(runs[1], folder)
    truth = (folder / 'truth.tum').read_text().splitlines()
    _, at_rest = truth[0].split(' ', 1)
    (folder / 'truth.tum').write_text('\n'.join(f'{line.split()[0]} {at_rest}' for line in truth))
    found = compare([runs[0], folder])
    assert set(found.numbers['a']['evo']) > set(found.numbers['rest']['evo']) >= {'ape_translation', 'ape_rotation'}
    assert 'ape_translation_aligned' not in found.numbers['rest']['evo']
    assert found.note == ''


def test_runs_called_alike_have_their_folder_s_name_too(tmp_path):
    folders = [make_run(tmp_path / name / 'run', 2.0, 0, (1.0, 1.4), with_output=False) for name in ('day', 'night')]
    assert compare(folders).names == ('day/run', 'night/run')


def test_runs_whose_folders_are_called_alike_too_have_one_more(runs, tmp_path):
    folders = [tmp_path / name / 'runs' / '1' for name in ('day', 'night')]
    for folder in folders:
        copytree(runs[0], folder)
    assert compare([*folders, runs[1]]).names == ('day/runs/1', 'night/runs/1', 'b')
