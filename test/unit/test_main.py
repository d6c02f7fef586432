"""The entry point: usage, unusable input, missing extras."""

import pytest

from thermal_fiducial.cli.main import COMMANDS, main


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


def test_unusable_input_is_one_line(tmp_path, capsys):
    assert main(['evaluate', str(tmp_path / 'missing')]) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert str(tmp_path / 'missing') in error


def test_a_missing_extra_is_named(capsys, monkeypatch):
    def without_rich(name):
        raise ModuleNotFoundError("No module named 'rich'", name='rich.progress')

    monkeypatch.setattr('thermal_fiducial.cli.main.import_module', without_rich)
    assert main(['simulate', 'somewhere']) == 2
    assert 'thermal-fiducial simulate: needs the Python package rich' in capsys.readouterr().err
