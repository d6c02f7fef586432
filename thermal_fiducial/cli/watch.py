"""``watch``: whether the pose may be flown on, live in a terminal."""

import argparse
from collections.abc import Callable
from contextlib import suppress
import sys
import time
from typing import Any, TYPE_CHECKING

from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.ranges import LISTEN_S
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.watching.live_status import Advice, LiveState, LiveStatus

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {Advice.FLY: 'green', Advice.CARE: 'yellow', Advice.STOP: 'red'}
_LEVELS = ('green', 'yellow', 'red')
#: Intervals of lines on a plain terminal and of updates of a screen [s].
_LINE_S, _SCREEN_S = 1.0, 0.25


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.description = (
        'Show whether the pose may be flown on, and why not: markers in view, rates, latency, sigma, clock offset, '
        'what the nodes say, the last refusals. Needs no display; without rich, or into a file, a plain line a second.'
    )
    parser.add_argument(
        '--once', action='store_true', help='show the state once and end; exit status 1 unless the pose may be flown on'
    )
    parser.add_argument('--wait', type=LISTEN_S, default=3.0, help='with --once: time to listen before [s]')
    parser.add_argument('--plain', action='store_true', help='lines of plain text, no screen')
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[], help='remaps and the like, as for any node; last'
    )
    parser.refuse(['--wait'], 'without --once', lambda args: not args.once)


def run(args: argparse.Namespace) -> int:
    """Show the state until interrupted."""
    try:
        from thermal_fiducial.ros.watching.watcher import watch
    except ModuleNotFoundError as error:
        raise InputError(f'watching needs ROS 2 ({error.name} is missing)') from None
    if args.once:
        last: list[LiveState] = []

        def keep(status: LiveStatus) -> bool:
            last.append(status.snapshot(time.monotonic()))
            return True

        watch(keep, args.wait, args.ros_args)
        _show_once(last[0], plain=args.plain)
        return int(last[0].advice is Advice.STOP)
    # Interrupting is the usual end.
    with suppress(KeyboardInterrupt):
        _follow(watch, args)
    return 0


def _follow(watch: Callable[..., None], args: argparse.Namespace) -> None:
    live = None if args.plain or not sys.stdout.isatty() else _live_screen()
    if live is None:
        watch(_print_line, _LINE_S, args.ros_args)
        return

    def draw(status: LiveStatus) -> bool:
        live.update(screen(status.snapshot(time.monotonic())), refresh=True)
        return False

    with live:
        watch(draw, _SCREEN_S, args.ros_args)


def _print_line(status: LiveStatus) -> bool:
    print(status.snapshot(time.monotonic()).line, flush=True)
    return False


def _show_once(snapshot: LiveState, *, plain: bool) -> None:
    if not plain and sys.stdout.isatty():
        try:
            from rich.console import Console
        except ImportError:
            pass
        else:
            Console().print(screen(snapshot))
            return
    print(snapshot.line)


def _live_screen() -> Any:
    """A screen that can be updated; None without rich."""
    try:
        from rich.live import Live
    except ImportError:
        return None
    return Live(auto_refresh=False, screen=True)


def screen(snapshot: LiveState) -> 'RenderableType':
    """The state as a screen of the terminal."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    colour = _COLOURS[snapshot.advice]
    words = Text('\n'.join(snapshot.reasons) or 'all is well', overflow='fold')
    head = Panel(words, title=Text(f'The pose {snapshot.advice.value}', style=f'bold {colour}'), border_style=colour)
    figures = Table(show_header=False, box=None, padding=(0, 2))
    figures.add_column()
    figures.add_column(justify='right')
    figures.add_column()
    for reading in snapshot.readings:
        figures.add_row(reading.name, Text(reading.value or '–', style='bold'), reading.unit)
    nodes = Table(show_header=False, box=None, padding=(0, 2))
    for node, level, message in snapshot.nodes:
        nodes.add_row(node, Text(message, style=_LEVELS[min(level, 2)], overflow='fold'))
    refusals = Table(show_header=False, box=None, padding=(0, 2))
    for age, why in snapshot.refusals:
        refusals.add_row(f'{age:.0f} s ago', Text(why, overflow='fold'))
    if not snapshot.refusals:
        refusals.add_row('none')
    titles = [Text(f'\n{title}', style='bold') for title in ('Nodes', 'Last refusals')]
    return Group(head, figures, titles[0], nodes, titles[1], refusals)
