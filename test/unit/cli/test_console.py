"""What people see on the console: progress without a terminal, tables in narrow windows, errors with the right noun."""

import io

import pytest
from rich.console import Console

from thermal_fiducial.cli import progress
from thermal_fiducial.cli import terminal_tables as tables
from thermal_fiducial.cli.main import main
from thermal_fiducial.cli.progress import counted, LINE_EVERY_S, progress_bar


class Clock:
    """A time that passes when it is asked to."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


def test_progress_is_a_line_every_few_seconds_without_a_terminal(capsys, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(progress, 'time', clock)
    with progress_bar('replay hall') as show:
        for step in range(100):
            clock.now += 0.11
            show(step / 100, 'markers')
    lines = capsys.readouterr().err.splitlines()
    # Eleven seconds.
    assert len(lines) == int(11.0 / LINE_EVERY_S)
    assert lines[0] == 'replay hall: markers, 45 %'


def test_pieces_are_counted(capsys, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(progress, 'time', clock)
    with progress_bar('wall, 20 s') as show:
        advance = counted(show, 600)
        advance(100)
        clock.now += LINE_EVERY_S
        advance(200)
    assert capsys.readouterr().err == 'wall, 20 s: 50 %\n'


def test_short_work_prints_no_progress_without_a_terminal(capsys):
    with progress_bar('quick') as show:
        show(0.5)
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(
    ('command', 'headers'),
    [
        (['markers', 'plan', '--distances', '1,12'], {'distance', 'position', 'rotation'}),
        (['markers', 'check', '--ids', '0'], {'narrowest', 'contacts', 'longest'}),
    ],
)
def test_no_word_of_a_header_is_cut_at_80_columns(command, headers, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert '…' not in shown
    assert headers <= set(shown.split())


def test_a_table_wider_than_the_window_keeps_its_words(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(tables, 'Console', lambda: Console(file=out, width=30))
    table = tables.table_of('many', [f'headline{index}' for index in range(8)])
    table.add_row(*map(str, range(8)))
    tables.show(table)
    assert all(f'headline{index}' in out.getvalue() for index in range(8))


def test_a_table_that_fits_the_window_stays_within_it(monkeypatch):
    """Between its least and its natural width rich prints beyond the window, and cuts the last column."""
    out = io.StringIO()
    monkeypatch.setattr(tables, 'Console', lambda: Console(file=out, width=80))
    headers = 'marker|views [frames]|first view [s]|corner sigma [px]|residual [px]|sigma [mm]|sigma [deg]|error [mm]'
    table = tables.table_of('', headers.split('|'))
    table.add_row('0', '171', '4.10', '0.0173', '-', '0', '0', '0.000001')
    tables.show(table)
    shown = out.getvalue()
    assert set(headers.replace('|', ' ').split()) | {'0.000001'} <= set(shown.split())
    assert max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize(
    ('command', 'said'),
    [
        (['replay', 'nope.mcap', '--out', 'run', '--no-report'], 'nope.mcap: no such bag'),
        (['replay', 'nope.mcap', '--out', 'run', '--rate', '2'], '--rate has no effect without --transport processes'),
        (['calibrate', 'intrinsics', 'nope'], 'nope: no such folder of pictures, bag or CSV file'),
        (['calibrate', 'intrinsics', 'run'], 'run: no pictures'),
        (['evaluate', 'nope'], 'nope: no such run folder'),
        (['evaluate', 'a.txt'], 'a.txt: is a file, not a run folder'),
        (['import', 'a.txt', '--out', 'bag'], 'a.txt: is a file, not a folder'),
        (['map', 'refine', 'run', 'map.yaml'], 'run: is a folder, not a file'),
    ],
)
def test_inputs_that_are_missing_or_of_another_kind_are_named(command, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'a.txt').touch()
    (tmp_path / 'run').mkdir()
    (tmp_path / 'map.yaml').touch()
    assert main(command) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    'command',
    [
        ['calibrate', 'intrinsics', 'views', '--out'],
        ['calibrate', 'intrinsics', 'views', '--report'],
        ['calibrate', 'camera-imu', 'motion', '--map', 'map.yaml', '--calibration', 'lens.yaml', '--out'],
        ['calibrate', 'imu', 'rest', '--out'],
        ['map', 'build', 'photos', '--out'],
        ['map', 'refine', 'map.yaml', 'run', '--out'],
        ['map', 'merge', 'map.yaml', 'other.yaml', '--out'],
        ['map', 'show', 'map.yaml', '--plot'],
        ['evaluate', 'run', 'run', '--compare', '--out'],
        ['markers', 'plan', '--plot'],
        ['markers', 'dictionary'],
        ['markers', 'measure'],
    ],
)
@pytest.mark.parametrize(('name', 'said'), [('results/file.yaml', 'no folder results'), ('here', 'is a folder')])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(command, name, said, tmp_path, capsys, monkeypatch):
    """The inputs are not there: they would be complained of if they had been looked for."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'here').mkdir()
    with pytest.raises(SystemExit, match='2'):
        main([*command, name])
    assert f'{name}: {said}' in capsys.readouterr().err


def test_missing_ground_truth_is_no_bag(tmp_path):
    from thermal_fiducial.errors import InputError
    from thermal_fiducial.report.trajectory import read_truth

    with pytest.raises(InputError, match=r'nope\.tum: no such ground truth'):
        read_truth(tmp_path / 'nope.tum')


def test_replay_refuses_a_folder_that_holds_other_things(tmp_path, capsys):
    mine = tmp_path / 'thesis'
    mine.mkdir()
    (mine / 'chapter.tex').write_text('mine')
    assert main(['replay', str(tmp_path / 'flight.mcap'), '--out', str(mine), '--no-report']) == 2
    # Before the bag is even looked for.
    assert f'{mine} exists and is no earlier run: choose another folder with --out' in capsys.readouterr().err
    assert [path.name for path in mine.iterdir()] == ['chapter.tex']


def test_rows_stay_on_one_line_where_headers_can_be_broken(capsys, monkeypatch):
    """Of 80 columns headers got as much as cells: each marker of ``markers check`` took two lines."""
    monkeypatch.setenv('COLUMNS', '80')
    headers = ('ID', 'one piece', 'islands', 'point contacts', 'narrowest web mm', 'of', 'longest arm cells')
    table = tables.table_of('', headers, left=['of'])
    table.add_row('0', 'yes', '0', '0', '3.0', 'hole wall', '1')
    tables.show(table)
    assert 'hole wall' in capsys.readouterr().out


def test_no_number_of_a_map_is_cut_at_80_columns(tmp_path, capsys, monkeypatch):
    entry = '{id: 7, size: 0.127, fixed: true, position: [-4.1433, 0.0309, -3.6953], orientation: [0, 0, 0, 1]}'
    path = tmp_path / 'map.yaml'
    path.write_text(
        'format: thermal_fiducial/marker_map\nversion: 1\nframe_id: map\n'
        f'dictionary: DICT_4X4_50\nmarkers:\n  - {entry}\n'
    )
    monkeypatch.setenv('COLUMNS', '80')
    assert main(['map', 'show', str(path)]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown.split() for word in ('-4.1433', '0.0309', '-3.6953', '0.127', 'faces', 'status'))
