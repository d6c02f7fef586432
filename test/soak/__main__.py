"""``make soak``: an hour of flight in mapping, one process a node, in real time; memory, CPU and error by the minute.

The exit status says whether a node grew, the error did, poses were missing, or a node did not end as it should.
"""

import argparse
from pathlib import Path
import sys
import tempfile

from soak.flying import soak
from soak.laps import lap, Laps
from soak.minutes import faults, growth_mb, HEAD, trend_mm


def main() -> int:
    """Exit status: 0, or 1 where something was amiss."""
    parser = argparse.ArgumentParser(prog='soak', description=__doc__)
    parser.add_argument('--minutes', type=float, default=60.0, help='of flight (default: %(default)g)')
    parser.add_argument('--small', action='store_true', help='pictures of 320x256, a quarter of the work')
    parser.add_argument('--lockstep', action='store_true', help='all nodes in one process, as fast as they go')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print('rendering a lap', file=sys.stderr)
        # The last second is for the row of the last minute.
        with Laps(folder, lap(small=arguments.small), 60.0 * arguments.minutes + 1.0) as laps:
            print(HEAD, flush=True)
            say = lambda line: print(line, flush=True)  # noqa: E731
            minutes, warnings = soak(laps, folder, say, lockstep=arguments.lockstep)
            found = faults(minutes, laps.imu_count, warnings)
    if len(minutes) > 1:
        print('grown since the second minute [MB], of it shared memory:')
        for name, (grown, shared) in growth_mb(minutes).items():
            print(f'  {name}: {grown:.1f}, {shared:.1f}')
        print('error has risen by {:.2f} mm, standard error {:.2f} mm'.format(*trend_mm(minutes)))
    print('\n'.join(found) or 'nothing amiss')
    return int(bool(found))


if __name__ == '__main__':
    sys.exit(main())
