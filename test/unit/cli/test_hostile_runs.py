"""Run folders that are meant to hurt ``evaluate``: one line each, never a traceback."""

from importlib.util import find_spec
import os
import shutil

import pytest
from support.run_folders import make_run

from thermal_fiducial.cli.main import main


@pytest.fixture(scope='module')
def small_run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp('small') / 'run', seconds=1.0, gap=(0.5, 0.6), with_output=False)


def huge(path):
    with path.open('wb') as file:
        file.truncate(1 << 34)


@pytest.mark.parametrize('kind', [os.mkfifo, huge, lambda path: path.symlink_to('/dev/zero')])
@pytest.mark.parametrize(
    'name',
    ['summary.json', 'parameters.yaml', 'marker_map.yaml', 'detections.csv', 'latency.csv', 'fused.tum', 'truth.tum'],
)
def test_what_is_no_file_is_refused_in_one_line(small_run, tmp_path, capsys, name, kind):
    run = shutil.copytree(small_run, tmp_path / 'run')
    (run / name).unlink(missing_ok=True)
    kind(run / name)
    compared = [[str(small_run), '--compare']] if find_spec('evo') else []
    for words in ([], *compared):
        assert main(['evaluate', str(run), *words, '--no-report']) == 2
        line = capsys.readouterr().err
        assert str(run / name) in line
        assert line.count('\n') == 1


@pytest.mark.parametrize('share', [0.0, 0.5, 0.99])
def test_a_summary_that_is_cut_short_is_named_in_one_line(small_run, tmp_path, capsys, share):
    """By a full disk or a battery that ran out, then copied without a look."""
    run = shutil.copytree(small_run, tmp_path / 'run')
    data = (run / 'summary.json').read_bytes()
    (run / 'summary.json').write_bytes(data[: int(share * len(data))])
    compared = [[str(small_run), '--compare']] if find_spec('evo') else []
    for words in ([], *compared):
        assert main(['evaluate', str(run), *words, '--no-report']) == 2
        line = capsys.readouterr().err
        assert f'{run / "summary.json"}: cut short or damaged' in line
        assert line.count('\n') == 1


@pytest.mark.parametrize(
    'field',
    [
        '"duration_s": "long"',
        '"duration_s": [1]',
        '"duration_s": NaN',
        '"duration_s": 1e17',
        '"start_ns": "then"',
        '"start_ns": null',
        '"start_ns": 1e400',
        '"diagnostics": [1]',
        '"diagnostics": {"a": 1}',
        '"diagnostics": {"marker_mapper": {"quarantined": {}}}',
        '"cpu_percent": {"pose_ekf": "much"}',
        '"mode": {}',
        '"bag": "\\u0000"',
        '"bag_path": "\\u0000"',
        '"remaps": {"a": 1}',
        '"transport": null',
    ],
)
def test_a_summary_of_other_kinds_is_refused_in_one_line(small_run, tmp_path, capsys, field):
    run = shutil.copytree(small_run, tmp_path / 'run')
    (run / 'summary.json').write_text('{' + field + '}')
    assert main(['evaluate', str(run)]) == 2
    line = capsys.readouterr().err
    assert f'summary.json: {field.split(chr(34))[1]} ' in line
    assert line.count('\n') == 1
