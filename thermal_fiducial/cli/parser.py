"""Parsers of the program and its commands: help, errors, and options that would have no effect."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
import re
from typing import Any, NoReturn, TypeAlias

from thermal_fiducial.cli.arguments import any_path
from thermal_fiducial.errors import InputError

PROGRAM = 'thermal-fiducial'

Commands: TypeAlias = 'argparse._SubParsersAction[Parser]'


@dataclass(frozen=True)
class _Rule:
    """Options that have no effect ``beside`` others, which is the case ``when`` the arguments are these."""

    options: Sequence[str]
    beside: str
    when: Callable[[argparse.Namespace], bool]


class _Help(argparse.HelpFormatter):
    """Adds the default to the help of each option that does not mention it; keeps the lines of long texts."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        needs_none = action.nargs == 0 or action.required
        if needs_none or not action.option_strings or 'default' in (action.help or ''):
            return action.help
        values = list(default) if isinstance(default, (list, tuple)) else [default]
        if not values or values[0] in (None, ''):
            values = ['none']
        text = ' '.join(f'{value:g}' if isinstance(value, float) else str(value) for value in values)
        return f'{action.help or ""} (default: {text.replace("%", "%%")})'.lstrip()

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = text.splitlines()
        return text if len(lines) > 1 else super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """Parser of the program; argparse uses the same class for its commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{'formatter_class': _Help, **options})
        self.register('type', Path, any_path)
        # Programs print -0.00003 as -3e-05, which argparse before Python 3.14 takes for an option.
        self._negative_number_matcher = re.compile(r'-\.?\d')
        self._rules: list[_Rule] = []
        self._given: set[str] = set()

    def refuse(self, options: Sequence[str], beside: str, when: Callable[[argparse.Namespace], bool]) -> None:
        """Refuse options where they would have no effect, which nobody wants who gives them.

        Parameters
        ----------
        options : of this parser, each as it is written in full
        beside : what makes them ineffective, an option too, as it continues "--x has no effect"
        when : whether it does, from the arguments
        """
        self._rules.append(_Rule(options, beside, when))

    def parse_known_args(self, *given: Any, **options: Any) -> Any:
        """Name arguments that a command does not have with its own usage; argparse does with that of the program.

        Raises
        ------
        InputError
            An option has no effect.
        """
        self._given = set()
        args, unknown = super().parse_known_args(*given, **options)
        if unknown and self.prog != PROGRAM:
            self.error(f'unrecognized arguments: {" ".join(unknown)}')
        for rule in self._rules:
            useless = [option for option in rule.options if option in self._given]
            if useless and rule.when(args):
                raise InputError(f'{useless[0]} has no effect {rule.beside}')
        return args, unknown

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Note which options are given: the values alone do not show it of one with its default."""
        self._given.update(action.option_strings)
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        """End the process for wrong usage, and name what lists the arguments."""
        super().error(f'{message} ({self.prog} --help)')


def add_command(commands: Commands, name: str, text: str) -> Parser:
    """Parser of a new sub-command; ``text`` stands in the list of them and in the sub-command's own help."""
    return commands.add_parser(name, help=text, description=text[0].upper() + text[1:])
