"""Options that would have no effect beside others are refused in one line, instead of ignored."""

import pytest

from thermal_fiducial.cli.main import main

MARKERS = ['markers', 'make', '--ids', '1']
BOARD = ['markers', 'board']
INTRINSICS = ['calibrate', 'intrinsics']
PLATE = '--dictionary --size --thickness --stand-off --corner-radius --bridge-width --tie-width --quiet-cells --min-web'


@pytest.mark.parametrize(
    ('words', 'option', 'other'),
    [
        (['evaluate', 'run', '--bag', 'bag', '--no-report'], '--bag', '--no-report'),
        (['evaluate', 'run', '--compare', '--out', 'page.html', '--no-report'], '--out', '--no-report'),
        (['evaluate', 'run', '--out', 'page.html'], '--out', '--compare'),
        (['evaluate', 'run', '--compare', '--truth-map', 'map.yaml'], '--truth-map', '--compare'),
        (['check-bridge', 'run', '--seconds', '15'], '--seconds', 'RECORDING'),
        (['check-bridge', 'run', '--ros-args', '-r', 'a:=b'], '--ros-args', 'RECORDING'),
        (['check-bridge', '--imu', 'bag'], '--imu', 'RECORDING'),
        (['watch', '--wait', '3'], '--wait', '--once'),
        (['replay', 'bag', '--out', 'run', '--rate', '2'], '--rate', '--transport processes'),
        *((['simulate', 'out', '--scenario', 'april', *words.split()], words.split()[0], '--scenario') for words in (
            '--contrast 3', '--inverted', '--fog 0.1', '--lag 0.01', '--readout 0.01', '--ffc never', '--workers 2'
        )),
        (['markers', 'plan', '--calibration', 'tau2.yaml', '--lens', '13'], '--lens', '--calibration'),
        ([*MARKERS, '--paper', 'A4', '--formats', 'svg'], '--paper', '--formats'),
        ([*MARKERS, '--frame-width', '15'], '--frame-width', '--mount frame'),
        *(([*MARKERS, '--mount', 'none', option, '5'], option, '--mount none')
          for option in ('--hole-diameter', '--stand-off', '--tie-width')),
        *(([*BOARD, 'circles', option, '3'], option, 'circles') for option in PLATE.split()),
        ([*BOARD, 'circles', '--mount', 'none'], '--mount', 'circles'),
        ([*BOARD, 'markers', '--diameter', '20'], '--diameter', 'markers'),
        *(([*INTRINSICS, 'views', *words.split()], words.split()[0], other) for words, other in (
            ('--board map.yaml', '--target markers'),
            ('--plate-thickness 0.003', '--target markers'),
            ('--diameter 20', '--target circles'),
            ('--missing 0,0', '--target circles'),
            ('--longer-rows 1', '--target circles'),
            ('--grid 8 6 --target markers', '--target markers'),
            ('--spacing 50 --target markers', '--target markers'),
            ('--size 640 512', 'CSV'),
        )),
        *(([*INTRINSICS, 'points.csv', '--size', '640', '512', *words.split()], words.split()[0], 'CSV') for words in (
            '--target circles', '--grid 8 6', '--spacing 50', '--every 5', '--most-views 80', '--remap a:=b'
        )),
        *((['map', '--marker-size', '0.3', name, 'map.yaml'], '--marker-size', name)
          for name in ('undo', 'history', 'upgrade')),
    ],
)  # fmt: skip
def test_refused_with_both_names(words, option, other, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f': {option} has no effect with' in line or f': {option} has no effect on' in line
    assert other in line.split(' has no effect ')[1]


@pytest.mark.parametrize('words', [('--every', '5'), ('--remap', 'a:=b')])
def test_options_for_bags_are_refused_with_pictures(words, capsys, tmp_path):
    assert main(['calibrate', 'intrinsics', str(tmp_path), *words]) == 2
    assert f': {words[0]} has no effect with a folder of pictures' in capsys.readouterr().err


@pytest.mark.parametrize(
    'words',
    [
        ('markers', 'check', '--stand-off', '10'),
        *(('map', name, 'map.yaml', '--marker-size', '0.3') for name in ('undo', 'history', 'upgrade')),
    ],
)
def test_commands_have_no_option_that_they_always_refuse(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert f'unrecognized arguments: {words[-2]}' in capsys.readouterr().err


def test_frames_for_a_video_are_read_from_a_named_bag(capsys):
    assert main(['evaluate', 'no_run', '--bag', 'bag', '--no-report', '--video']) == 2
    assert 'no effect' not in capsys.readouterr().err
