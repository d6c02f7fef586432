"""The entry point: usage, unusable input, missing extras."""

import argparse
import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from support.interrupts import interrupted
from support.small_bag import map_of

from thermal_fiducial.cli.main import COMMANDS, main
from thermal_fiducial.files.marker_map import save_map


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, '--help'])
    assert stopped.value.code == 0
    assert f'thermal-fiducial {command}' in capsys.readouterr().out


@pytest.mark.parametrize('argv', [[], ['fly'], ['simulate', '--no-such-option']])
def test_wrong_usage_exits_with_2(argv, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(argv)
    assert stopped.value.code == 2
    assert 'usage: thermal-fiducial' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('argv', 'lists'),
    [
        ([], 'thermal-fiducial --help'),
        (['map'], 'thermal-fiducial map --help'),
        (['map', 'fix'], 'map fix --help'),
        (['markers', 'check', 'x.png'], 'markers check --help'),
    ],
)
def test_wrong_usage_names_what_lists_the_arguments(argv, lists, capsys):
    with pytest.raises(SystemExit):
        main(argv)
    assert lists in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    'words',
    [
        ['demo', '--seed', '-1'],
        ['map', 'refine', 'map.yaml', 'run', '--max-frames', '0'],
        ['markers', 'dictionary', 'own.yaml', '--restarts', '2.5'],
        ['markers', 'plan', '--bits', '99999'],
        ['calibrate', 'intrinsics', 'views', '--grid', '99999', '99999'],
    ],
)
def test_numbers_that_cannot_be_are_named_with_their_option(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    (option,) = (word for word in words if f'argument {word}: ' in last)
    assert f'argument {option}: {words[words.index(option) + 1]!r} is not a whole number' in last


@pytest.mark.parametrize(
    ('command', 'option'),
    [
        *(
            ('markers plan', option)
            for option in ('--netd', '--stand-off', '--contrast', '--after', '--loss', '--fog', '--distances', '--lens')
        ),
        *(('calibrate intrinsics views', option) for option in ('--spacing', '--diameter', '--focal-px')),
        *(('map move map.yaml 1 --position 0 0 0', option) for option in ('--sigma', '--sigma-deg')),
        ('map show map.yaml', '--marker-size'),
    ],
)
@pytest.mark.parametrize('value', ['-1', '1e9', '1e300', 'nan', 'inf'])
def test_numbers_that_nothing_real_has_are_named_with_their_option(command, option, value, capsys):
    """Nothing is computed with them, which took long, ended in a traceback, or said something about nothing."""
    try:
        status = main([*command.split(), f'{option}={value}'])
    except SystemExit as stopped:
        status = stopped.code
    assert status == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert option in last
    assert f'{float(value):g}' in last or repr(value) in last


@pytest.mark.parametrize('side', ['1e-300', '0'])
def test_lengths_that_are_next_to_nothing_are_refused(side, capsys):
    for command, option in (('calibrate intrinsics views', '--spacing'), ('map show map.yaml', '--marker-size')):
        with pytest.raises(SystemExit, match='2'):
            main([*command.split(), option, side])
        assert f'argument {option}: {side!r} is no' in capsys.readouterr().err


@pytest.mark.parametrize(
    'words',
    [
        ['map', 'history', ''],
        ['map', 'undo', ''],
        ['markers', 'make', '--out', ''],
        ['markers', 'measure', ''],
        ['evaluate', 'run', '--truth', ''],
        ['replay', 'bag', '--out', ''],
    ],
)
def test_an_empty_path_is_not_the_folder_of_the_command(words, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(words)
    assert 'a path cannot be empty' in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize('option', ['--formats', '--paper'])
def test_what_a_message_quotes_is_on_its_line(tmp_path, option, capsys):
    assert main(['markers', 'make', '--ids', '0', '--out', str(tmp_path), option, 'a\nb']) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'a?b' in line


@pytest.mark.ros
@pytest.mark.parametrize('topic', ['-', '/', 'a b'])
def test_a_topic_that_cannot_be_is_named(topic, capsys):
    assert main(['check-bridge', '--topic', topic]) == 2
    assert capsys.readouterr().err == f'thermal-fiducial check-bridge: --topic {topic!r} is not the name of a topic\n'


@pytest.mark.parametrize('name', ['a' * 300, 'a/' * 3000, 'file/b'])
@pytest.mark.parametrize(
    'words',
    [['evaluate'], ['replay', '--out', 'run'], ['calibrate', 'intrinsics'], ['import', '--out', 'bag'], ['simulate']],
)
def test_names_that_no_file_can_have_are_refused_in_one_line(tmp_path, capfd, monkeypatch, words, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').write_text('')
    assert main([*words, name]) == 2
    error = capfd.readouterr().err
    assert error.count('\n') == 1
    assert len(error) < 600


def test_a_missing_extra_is_named(capsys, monkeypatch):
    def without_rich(name):
        raise ModuleNotFoundError("No module named 'rich'", name='rich.progress')

    monkeypatch.setattr('thermal_fiducial.cli.main.import_module', without_rich)
    assert main(['simulate', 'somewhere']) == 2
    assert 'thermal-fiducial simulate: needs the Python package rich' in capsys.readouterr().err


class CaughtError(Exception):
    """Carries a parser that is complete."""


def parsers_of(command, monkeypatch):
    """The parser of a command and those of all its actions."""

    def catch(parser, argv):
        raise CaughtError(parser)

    monkeypatch.setattr(argparse.ArgumentParser, 'parse_args', catch)
    with pytest.raises(CaughtError) as caught:
        main([command])
    waiting, found = [caught.value.args[0]], []
    while waiting:
        parser = waiting.pop()
        found.append(parser)
        for action in actions(parser):
            if isinstance(action.choices, dict):
                waiting += [
                    choice for name, choice in action.choices.items() if parser is not found[0] or name == command
                ]
    return found


def actions(parser):
    """Options, arguments and sub-commands: argparse has no public list of them."""
    return parser._actions  # noqa: SLF001


@pytest.mark.parametrize('command', COMMANDS)
def test_help_describes_every_option_with_its_default(command, monkeypatch):
    for parser in parsers_of(command, monkeypatch):
        text = ' '.join(parser.format_help().split())
        assert parser.description, parser.prog
        for action in actions(parser):
            if not action.option_strings:
                continue
            assert action.help, f'{parser.prog} {action.option_strings}'
            # As argparse itself expands it; it offers no other way.
            said = ' '.join(parser._get_formatter()._expand_help(action).split())  # noqa: SLF001
            assert said in text
            if action.nargs != 0 and not action.required:
                assert 'default' in said, f'{parser.prog} {action.option_strings}'
                assert said.count('default') == 1, f'{parser.prog} {action.option_strings}'


@pytest.mark.parametrize('command', COMMANDS)
def test_every_number_has_a_range_with_its_default_in_it(command, monkeypatch):
    """None holds NaN or infinity, as those of ``float`` do."""
    for parser in parsers_of(command, monkeypatch):
        for action in actions(parser):
            assert action.type not in (int, float), f'{parser.prog} {action.dest}'
            values = action.default if isinstance(action.default, list | tuple) else [action.default]
            if action.type is not None and all(type(value) in (int, float) for value in values):
                # argparse itself does not look.
                assert [action.type(str(value)) for value in values] == list(values)


@pytest.mark.parametrize('command', COMMANDS)
def test_help_fits_a_terminal_of_80_columns(command, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    for parser in parsers_of(command, monkeypatch):
        wide = [line for line in parser.format_help().splitlines() if len(line) > 80]
        assert not wide, f'{parser.prog}: {wide}'


@pytest.mark.parametrize(
    ('output', 'encoding', 'expected'),
    [
        ('/dev/full', 'utf-8', (2, 'thermal-fiducial map: output: No space left on device\n')),
        ('out', 'ascii', (0, '')),
    ],
)
def test_output_that_takes_nothing_or_not_every_letter(tmp_path, output, encoding, expected):
    """A full disk behind the output, and a terminal that has no letters but English ones."""
    path = tmp_path / 'größe.yaml'
    save_map(path, map_of((0, 1)))
    with (tmp_path / output).open('wb') as out:
        done = subprocess.run(
            [sys.executable, '-m', 'thermal_fiducial', 'map', 'check', str(path)],
            stdout=out,
            stderr=subprocess.PIPE,
            env={**os.environ, 'PYTHONIOENCODING': encoding},
            text=True,
            check=False,
        )
    assert (done.returncode, done.stderr) == expected


@pytest.mark.parametrize('closed', ['>&-', '2>&-', '>&- 2>&-'])
def test_a_command_runs_with_its_output_closed(tmp_path, closed):
    """As a service manager may start it: without stdout it ended with a traceback and status 1."""
    path = tmp_path / 'map.yaml'
    save_map(path, map_of((0, 1)))
    shell = f'"$0" -m thermal_fiducial map check "$1" {closed}'
    done = subprocess.run(['sh', '-c', shell, sys.executable, str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')


def test_a_demo_that_cannot_be_flown_leaves_the_earlier_one(tmp_path, capsys):
    (tmp_path / '.thermal_fiducial_demo').touch()
    (tmp_path / 'report.html').touch()
    assert main(['demo', '--out', str(tmp_path), '--seconds', '3']) == 2
    says = 'thermal-fiducial demo: 3 s is too short for take-off and landing: at least 11 s\n'
    assert capsys.readouterr().err == says
    assert (tmp_path / 'report.html').exists()


@pytest.mark.nightly
@pytest.mark.parametrize(('after_s', 'again'), [(0.3, False), (0.3, True), (6.0, True)])
def test_an_interrupt_of_simulate_is_one_line_and_leaves_nothing(tmp_path, after_s, again):
    """While its workers still import what they need, and while they render; a second one comes while Python ends."""
    words = ['simulate', tmp_path / 'bag', '--seconds', '20']
    status, error = interrupted(words, children, after_s, times=2 if again else 1, apart_s=0.2)
    # For a shell both are 130.
    assert status == 130 or (again and status == -signal.SIGINT)
    assert error[-1] == 'thermal-fiducial simulate: interrupted'
    assert not any('Traceback' in line for line in error)
    assert not (tmp_path / 'bag').exists()


def children(pid):
    """Of a process's main thread."""
    return Path(f'/proc/{pid}/task/{pid}/children').read_text().split()
