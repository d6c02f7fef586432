"""The flights of all faults and seeds, in processes of their own."""

from collections import deque
from collections.abc import Iterator, Sequence

from support.jobs import Died, outcomes

from faults import picture_faults
from faults.camera_faults import lone_map
from faults.flight import LENS, recorded
from faults.kinds import FAULTS
from faults.run import fly
from faults.score import Score, score


def score_of(index: int, seed: int) -> Score:
    """Score of a fault in the flight of a seed."""
    fault = FAULTS[index]
    flight = recorded(seed, picture_faults.LENS if fault.pictures else LENS)
    marker_map = lone_map(flight) if fault.lone else None
    return score(fly(flight, fault.stream(flight), marker_map, fault.mode), fault.ends)


def scores(chosen: Sequence[int], seeds: int, workers: int) -> Iterator[tuple[int, Score]]:
    """Scores as they are done, each with the number of its fault; a seed's flights follow each other.

    Raises
    ------
    RuntimeError
        The process of a flight was killed.
    """
    jobs = deque((index, seed) for seed in range(seeds) for index in chosen)
    for (index, seed), result in outcomes(score_of, jobs, workers):
        if isinstance(result, Died):
            raise RuntimeError(f'the process of seed {seed} with the fault "{FAULTS[index].name}" was killed')
        yield index, result
