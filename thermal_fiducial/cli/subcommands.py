"""Sub-commands of the program, and of its commands."""

import argparse
from typing import TypeAlias

Commands: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'


def add_command(commands: Commands, name: str, text: str) -> argparse.ArgumentParser:
    """Parser of a new sub-command; ``text`` stands in the list of them and in the sub-command's own help."""
    return commands.add_parser(name, help=text, description=text[0].upper() + text[1:])
