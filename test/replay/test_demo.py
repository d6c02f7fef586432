"""The demo from start to end, and the folders that it refuses."""

from dataclasses import replace
import json
import os

import numpy as np
from PIL import Image
import pytest

from thermal_fiducial.cli import demo
from thermal_fiducial.cli.demo import MARK
from thermal_fiducial.cli.main import main
from thermal_fiducial.sim.scenario import named


def quick():
    """The demo's flight as a camera of a quarter of the pixels and a third of the frames sees it."""
    fog = named(demo.SCENARIO)
    half = {name: tuple(0.5 * value for value in getattr(fog.lens, name)) for name in ('focal', 'centre')}
    lens = replace(fog.lens, width=320, height=256, **half)
    flight = replace(fog.flight, ground_time=0.8, climb_time=1.2, hover_time=0.5)
    return replace(fog, lens=lens, flight=flight, sensor=replace(fog.sensor, frame_rate=10.0))


@pytest.mark.ros
@pytest.mark.parametrize(
    ('scenario', 'seconds'),
    [(quick(), 5), pytest.param(demo.SCENARIO, 11, marks=pytest.mark.nightly)],
    ids=['quick', 'whole'],
)
def test_a_short_demo(tmp_path, capfd, monkeypatch, scenario, seconds):
    monkeypatch.setattr(demo, 'SCENARIO', scenario)
    # Processes that render start for longer than so few frames take.
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: {0})
    out, picture = tmp_path / 'demo', tmp_path / 'picture.png'
    out.mkdir()
    for name in (MARK, 'old'):
        (out / name).touch()
    assert main(['demo', '--out', str(out), '--seconds', str(seconds), '--seed', '1', '--picture', str(picture)]) == 0
    assert not (out / 'old').exists()
    printed = capfd.readouterr().out
    assert 'position error, rms' in printed
    assert str(out / 'report.html') in printed
    numbers = json.loads((out / 'summary.json').read_text())['evaluation']
    assert numbers['fused']['poses'] > 90 * seconds
    # Far from what the algorithms reach: this is about the chain being whole, frames and signs included.
    assert numbers['fused']['error']['position_rms_mm'] < 30.0
    assert 'id="chart-available"' in (out / 'report.html').read_text()
    image = np.asarray(Image.open(picture).convert('RGB'))
    assert image.shape[1] > 1200
    assert image.std() > 20.0
    assert picture.stat().st_size < 400_000


@pytest.mark.parametrize(
    ('name', 'says'),
    [('nowhere/a.png', 'no folder'), ('a.xyz', 'not the name of a PNG'), ('.', 'not the name of a PNG')],
)
def test_a_picture_that_cannot_be_written_is_refused_before_the_flight(tmp_path, capsys, name, says):
    assert main(['demo', '--out', str(tmp_path / 'demo'), '--picture', str(tmp_path / name)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
    assert not list(tmp_path.iterdir())


def test_a_folder_of_somebody_else_is_never_replaced(tmp_path, capsys):
    (tmp_path / 'thesis.tex').write_text('years of work')
    assert main(['demo', '--out', str(tmp_path)]) == 2
    assert 'no earlier demo' in capsys.readouterr().err
    assert (tmp_path / 'thesis.tex').read_text() == 'years of work'


def test_a_demo_that_is_interrupted_while_it_removes_an_earlier_one_is_followed_by_another(tmp_path, monkeypatch):
    def interrupted(path):
        """The first of what is removed is gone."""
        sorted(path.iterdir())[0].unlink()
        raise KeyboardInterrupt

    (tmp_path / MARK).touch()
    (tmp_path / 'bag').mkdir()
    for name in ('one', 'two'):
        (tmp_path / 'bag' / name).touch()
    with monkeypatch.context() as patched:
        patched.setattr(demo.shutil, 'rmtree', interrupted)
        assert main(['demo', '--out', str(tmp_path)]) == 130
    assert (tmp_path / 'bag' / 'two').exists()
    # Refuses before it simulates what it would refuse to replace.
    monkeypatch.setattr(demo, '_simulate', lambda bag, flight: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(['demo', '--out', str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == [MARK]


def test_a_file_in_the_way_is_refused(tmp_path, capsys):
    (tmp_path / 'file').touch()
    assert main(['demo', '--out', str(tmp_path / 'file')]) == 2
    assert main(['demo', '--out', str(tmp_path / 'file' / 'demo')]) == 2
    assert capsys.readouterr().err.count('\n') == 2


@pytest.mark.parametrize('seconds', ['-3', '0', 'nan', 'inf'])
def test_an_impossible_length_is_refused(tmp_path, capsys, seconds):
    (tmp_path / MARK).touch()
    with pytest.raises(SystemExit) as ended:
        main(['demo', '--out', str(tmp_path), f'--seconds={seconds}'])
    assert ended.value.code == 2
    assert f"argument --seconds: '{seconds}' is not a number from 1 to 3600 s" in capsys.readouterr().err
    # What an earlier demo left is not thrown away for it.
    assert (tmp_path / MARK).exists()


def test_a_flight_that_is_too_short_to_land_is_refused(tmp_path, capsys):
    (tmp_path / MARK).touch()
    assert main(['demo', '--out', str(tmp_path), '--seconds=1.5']) == 2
    assert '1.5 s is too short' in capsys.readouterr().err
    assert (tmp_path / MARK).exists()
