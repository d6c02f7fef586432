"""``markers``: dictionaries, drawings and planning of markers that can be cut."""

import argparse
from collections import Counter
from shlex import quote

from thermal_fiducial.cli import marker_drawings, marker_planning
from thermal_fiducial.cli.arguments import add_force, file_to_write, refuse_to_overwrite, whole_number
from thermal_fiducial.cli.marker_choice import add_choice, chosen, name_look_alikes
from thermal_fiducial.cli.parser import add_command, Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.ranges import BITS, HAMMING, LENGTH_MM
from thermal_fiducial.cli.terminal_tables import show, table_of
from thermal_fiducial.core.detection.patterns import Dictionary
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.bridges import darkest_white, find_bridges
from thermal_fiducial.fabrication.cuttability import examine
from thermal_fiducial.fabrication.dictionary_search import distances, negatives, search
from thermal_fiducial.fabrication.plate import marker_drawing, PlateOptions
from thermal_fiducial.fabrication.strength import strength_of
from thermal_fiducial.files.dictionary import PACKAGED, save_dictionary


def add_arguments(parser: Parser) -> None:
    """Sub-commands of ``markers``."""
    commands = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    _add_check(add_command(commands, 'check', 'check which markers of a dictionary can be cut in one piece'))
    marker_drawings.add_make(add_command(commands, 'make', 'draw markers (SVG, DXF, PDF, PNG), one file a marker'))
    marker_drawings.add_sheet(add_command(commands, 'sheet', 'draw many markers nested on sheets of a given size'))
    _add_bridge(add_command(commands, 'bridge', 'list the bridges of markers of a standard dictionary'))
    marker_drawings.add_board(add_command(commands, 'board', 'draw thermal calibration boards'))
    _add_dictionary(add_command(commands, 'dictionary', 'search for a dictionary of markers that can be cut'))
    marker_planning.add_plan(
        add_command(commands, 'plan', 'predict detection, error of the pose and contrast over time')
    )
    marker_planning.add_measure(add_command(commands, 'measure', 'measure the tables of plan in simulation'))


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    return int(args.do(args))


def _add_check(parser: Parser) -> None:
    parser.set_defaults(do=_check)
    add_choice(parser)
    # Spacers change nothing of what is cut.
    marker_drawings.add_plate_options(parser, without=('stand_off',))


def _check(args: argparse.Namespace) -> int:
    dictionary, ids = chosen(args)
    bits = dictionary.bits
    options = marker_drawings.plate_options(args)
    table = table_of(
        '', ('ID', 'one piece', 'islands', 'point contacts', 'narrowest web mm', 'of', 'longest arm cells'), left=['of']
    )
    good, against = 0, Counter[str]()
    with progress_bar('measuring webs') as progress:
        for done, marker_id in enumerate(ids, 1):
            found = examine(bits[marker_id])
            drawing = marker_drawing(bits[marker_id], str(marker_id), options)
            strength = strength_of(drawing, options, dictionary.cells, args.min_web)
            against.update(strength.complaints)
            good += found.cuttable and not strength.complaints
            row = found.islands, found.point_contacts, f'{strength.web_mm:.1f}', strength.kind
            table.add_row(str(marker_id), 'yes' if found.cuttable else 'no', *map(str, row), str(found.longest_arm))
            progress(done / len(ids))
    show(table)
    for complaint, times in against.items():
        print(f'{times} of {number_of(len(ids), "marker")}: {complaint}')
    between, own = distances(bits[ids])
    # Nearer than markers of the dictionary are to one another: of few markers that are chosen these may be far apart.
    least = distances(bits)[0]
    pairs = negatives(bits[ids], least)
    for a, b, bits_apart in pairs:
        print(f'marker {ids[a]} and the negative of {ids[b]} differ in {number_of(bits_apart, "bit")}')
    if pairs:
        signed = ' or '.join(sorted(path.stem for path in PACKAGED.glob('*_SIGNED.yaml')))
        print(
            f'these are nearer to a negative than markers to one another ({number_of(least, "bit")}): where warm '
            f'plates in front of a cold surface may appear too, set polarity, or use {signed}, which have none'
        )
    name_look_alikes(dictionary, ids)
    apart = f'distance between markers {between}, ' if len(ids) > 1 else 'distance '
    print(f'{good} of {number_of(len(ids), "marker")} can be cut; {apart}to own rotations {own}')
    return 0


def _add_bridge(parser: Parser) -> None:
    parser.set_defaults(do=_bridge)
    add_choice(parser)
    parser.add_argument('--size', type=LENGTH_MM, default=300.0, metavar='MM', help='side of the black square')
    parser.add_argument('--bridge-width', type=LENGTH_MM, default=4.0, metavar='MM', help='width of a web')


def _bridge(args: argparse.Namespace) -> int:
    # The lengths that can be drawn.
    options = PlateOptions(size=args.size, bridge_width=args.bridge_width)
    dictionary, ids = chosen(args)
    bits = dictionary.bits
    cell = options.size / dictionary.cells
    table = table_of('', ('ID', 'patches', 'webs', 'longest web cells', 'read part of a white cell covered'))
    for marker_id in ids:
        bridges = find_bridges(bits[marker_id])
        longest = max((len(web) - 1 for web in bridges.webs), default=0)
        covered = darkest_white(bits[marker_id], bridges, cell, options.bridge_width)
        row = (marker_id, len(bridges.patches), len(bridges.webs), longest, f'{100 * covered:.0f} %')
        table.add_row(*map(str, row))
    show(table)
    return 0


def _add_dictionary(parser: Parser) -> None:
    parser.set_defaults(do=_dictionary)
    parser.add_argument(
        'out', type=file_to_write, help="dictionary file to write (YAML); its name becomes the dictionary's"
    )
    parser.add_argument('--bits', type=BITS, default=4, help='bits along a side')
    parser.add_argument('--distance', type=HAMMING, default=4, help='least Hamming distance')
    parser.add_argument(
        '--count', type=whole_number(1), help='number of markers to keep, the stiffest first (default: all)'
    )
    parser.add_argument('--seed', type=whole_number(0), default=1, help='the same seed and restarts give the same file')
    parser.add_argument('--restarts', type=whole_number(1), default=1000, help='codes to try')
    parser.add_argument(
        '--signed', action='store_true', help='keep the distance also from the negatives of all markers'
    )
    add_force(parser)


def _dictionary(args: argparse.Namespace) -> int:
    refuse_to_overwrite([args.out], args.force)
    with progress_bar('searching') as progress:
        bits = search(
            args.bits,
            args.distance,
            seed=args.seed,
            restarts=args.restarts,
            signed=args.signed,
            progress=lambda done, most: progress(done / args.restarts, number_of(most, 'marker')),
        )
    found = len(bits)
    if args.count is not None and args.count > found:
        raise InputError(f'{number_of(found, "marker")} found, not {args.count}; try more restarts')
    kept = bits[: args.count]
    count = ('' if args.count is None else f' --count {args.count}') + ' --signed' * args.signed
    command = f'--bits {args.bits} --distance {args.distance} --seed {args.seed} --restarts {args.restarts}{count}'
    made_by = f'thermal-fiducial markers dictionary {quote(args.out.name)} {command}'
    save_dictionary(args.out, args.out.stem, Dictionary(kept, (args.distance - 1) // 2), made_by)
    between, own = distances(kept)
    print(f'{args.out}: {len(kept)} of {number_of(found, "marker")}, distance {between}, to own rotations {own}')
    return 0
