"""``make rigs``: random rigs from pictures on, each with the known map and mapping from one marker."""

import argparse
from collections import deque
import sys

from support.jobs import Died, outcomes

from rigs.flight import fly
from rigs.rig import SECONDS
from rigs.score import Score
from rigs.table import line, table


def main() -> int:
    """Exit status: 0, or 1 where a flight was beyond its claims."""
    parser = argparse.ArgumentParser(prog='rigs', description=__doc__)
    parser.add_argument('begin', type=int, help='first seed')
    parser.add_argument('end', type=int, help='seed after the last')
    parser.add_argument(
        '--as-drawn', action='store_true', help='declare how large errors are where defaults claim more'
    )
    parser.add_argument('--workers', type=int, default=2, help='processes')
    arguments = parser.parse_args()
    seeds = deque((seed, SECONDS, arguments.as_drawn) for seed in range(arguments.begin, arguments.end))
    scores: dict[int, list[Score]] = {}
    for (seed, *_), result in outcomes(fly, seeds, arguments.workers):
        if isinstance(result, Died):
            raise RuntimeError(f'the process of seed {seed} was killed')
        description, scores[seed] = result
        print(description, *map(line, scores[seed]), sep='\n', flush=True)
    print(table(dict(sorted(scores.items()))))
    return int(any(score.is_beyond_claims for flight in scores.values() for score in flight))


if __name__ == '__main__':
    sys.exit(main())
