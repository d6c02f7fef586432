# ruff: noqa: SLF001
"""Numbers on the command line have ranges, which hold neither NaN nor infinity."""

import argparse
from importlib import import_module

import pytest

from thermal_fiducial.cli.main import COMMANDS, MODULES
from thermal_fiducial.cli.parser import Parser


def parsers_of(parser):
    """The parser and those of its actions, at any depth."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name in action.choices:
                yield from parsers_of(action.choices[name])


@pytest.mark.parametrize('command', COMMANDS)
def test_every_number_has_a_range(command):
    parser = Parser(prog=command)
    import_module(f'thermal_fiducial.cli.{MODULES.get(command, command.replace("-", "_"))}').add_arguments(parser)
    arguments = [(one.prog, action) for one in parsers_of(parser) for action in one._actions]
    assert [(prog, action.dest) for prog, action in arguments if action.type in (int, float)] == []
    for _, action in arguments:
        values = action.default if isinstance(action.default, list | tuple) else [action.default]
        if action.type is not None and all(type(value) in (int, float) for value in values):
            # Defaults are within the ranges; argparse itself does not look.
            assert [action.type(str(value)) for value in values] == list(values)
