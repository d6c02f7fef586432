"""``make fuzz``: mutated messages, files and bags for the nodes and commands; anything found is an error."""

import argparse
from pathlib import Path
import sys
import tempfile
import time

from fuzz.jobs import batches, findings
from thermal_fiducial.cli.replay import progress_bar


def main() -> int:
    """Exit status: 0, or 1 where something was found."""
    parser = argparse.ArgumentParser(prog='fuzz', description=__doc__)
    parser.add_argument('--inputs', type=int, default=10_000, help='half of them messages, half files and bags')
    parser.add_argument('--first', type=int, default=0, help='number of the first input: others make another run')
    parser.add_argument('--workers', type=int, default=2, help='processes')
    parser.add_argument('--target', choices=('messages', 'files'), help='only these')
    arguments = parser.parse_args()
    targets = [arguments.target] if arguments.target else ['messages', 'files']
    share = arguments.inputs // len(targets)
    jobs = [job for target in targets for job in batches(target, arguments.first, share)]
    begin, done, found = time.monotonic(), 0, []
    with tempfile.TemporaryDirectory() as folder, progress_bar('fuzz') as advance:
        for count, findings_of_batch in findings(jobs, arguments.workers, Path(folder)):
            done += count
            advance(done / arguments.inputs)
            found += findings_of_batch
            for finding in findings_of_batch:
                print(finding, flush=True)
    print(f'{done} inputs in {time.monotonic() - begin:.0f} s, {len(found)} findings')
    return int(bool(found))


if __name__ == '__main__':
    sys.exit(main())
