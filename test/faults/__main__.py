"""``make faults``: every fault in flights of several seeds, as a table for the documents."""

import argparse
from pathlib import Path
import re
import sys

from faults.jobs import scores
from faults.kinds import Fault, FAULTS
from faults.score import pooled, Score
from faults.table import table
from thermal_fiducial.cli.replay import progress_bar

TABLE = Path(__file__).resolve().parents[2] / 'doc' / 'tables' / 'faults.md'


def main() -> int:
    """Exit status: 0, or 1 where wrong poses went out undeclared for too long."""
    parser = argparse.ArgumentParser(prog='faults', description=__doc__)
    parser.add_argument('--seeds', type=int, default=8, help='flights for each fault')
    parser.add_argument('--workers', type=int, default=2, help='processes')
    parser.add_argument('--only', default='', metavar='REGEX', help='faults whose name holds this')
    parser.add_argument('--no-table', action='store_true', help='print it only')
    arguments = parser.parse_args()
    chosen = [index for index, fault in enumerate(FAULTS) if re.search(arguments.only, f'{fault.group} {fault.name}')]
    done: dict[int, list[Score]] = {index: [] for index in chosen}
    with progress_bar('faults') as advance:
        for count, (index, result) in enumerate(scores(chosen, arguments.seeds, arguments.workers), start=1):
            done[index].append(result)
            advance(count / (len(chosen) * arguments.seeds))
            if not sys.stderr.isatty():
                print(count, table([(FAULTS[index], result)], 1).splitlines()[-1], file=sys.stderr, flush=True)
    results: list[tuple[Fault, Score]] = [(FAULTS[index], pooled(found)) for index, found in done.items()]
    text = table(results, arguments.seeds)
    print(text)
    if not arguments.no_table:
        TABLE.write_text(text)
    return int(any(result.is_defect for fault, result in results if not fault.lone))


if __name__ == '__main__':
    sys.exit(main())
