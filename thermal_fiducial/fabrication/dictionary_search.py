"""Search for dictionaries of markers that can be cut.

A greedy search accepts each pattern that is far enough from those accepted before. Far more markers fit into a coset
of a linear code: let C be a linear code of n x n bits with minimum distance d that turning the grid by 90 degrees
maps onto itself, and v a pattern with v + R v in C. All words of v + C and all their rotations lie in v + C, so any two
of them differ in at least d bits. Of these the search keeps the cuttable ones, one of each four rotations.

Such codes are grown a dimension at a time: R acts unipotently on the patterns (R^4 = 1 in characteristic 2), so
every invariant code can be reached by adding, each time, a g with g + R g already in the code. The g of one step form a
space of at most 512 cosets at 6 x 6 bits, 65,536 at 8 x 8. All are tried, or a random part of them where they have more
words than an attempt has time for, and one of the suitable ones is chosen at random.
Background: F. MacWilliams, N. Sloane, "The Theory of Error-Correcting Codes", 1977.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from thermal_fiducial.core.types import Float32Array, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.bit_patterns import cuttable, rotate, rotations, unpack, weight, Words
from thermal_fiducial.fabrication.cuttability import examine

# Most words of a code, whose cosets have a quarter as many markers; and most that are examined in a step, a second's.
_MOST_WORDS, _MOST_EXAMINED = 1 << 18, 1 << 24
# Words that are examined at a time: 8 MB, and as much a few times on the way.
_WORDS_AT_A_TIME = 1 << 20
# Markers that are compared with all at a time: 30,000 among themselves would take gigabytes.
_AT_A_TIME = 256


@dataclass
class LinearCode:
    """A linear code of n x n bits, invariant under turning the grid."""

    n: int
    #: rows in reduced echelon form, by their highest bit
    basis: dict[int, int] = field(default_factory=dict)
    words: Words = field(default_factory=lambda: np.zeros(1, np.uint64))

    def add(self, generator: int) -> None:
        """Extend the code by one dimension."""
        row = self.reduce(generator)
        lead = row.bit_length() - 1
        for other in self.basis:
            if self.basis[other] >> lead & 1:
                self.basis[other] ^= row
        self.basis[lead] = row
        self.words = np.concatenate([self.words, self.words ^ np.uint64(generator)])

    def reduce(self, word: int) -> int:
        """Representative of the coset of ``word``."""
        for lead, row in self.basis.items():
            if word >> lead & 1:
                word ^= row
        return word

    def invariant_cosets(self) -> Words:
        """A representative of each coset that turning the grid maps onto itself, the code's own (0) first."""
        kernel: list[int] = []
        images: dict[int, tuple[int, int]] = {}
        units = [1 << bit for bit in range(self.n * self.n) if bit not in self.basis]
        turned = rotate(np.array(units, dtype=np.uint64), self.n)
        for unit, image in zip(units, turned, strict=True):
            word, image = unit, self.reduce(unit ^ int(image))
            while image and (image.bit_length() - 1) in images:
                other_image, other_word = images[image.bit_length() - 1]
                word, image = word ^ other_word, image ^ other_image
            if image:
                images[image.bit_length() - 1] = (image, word)
            else:
                kernel.append(word)
        return span(kernel)


def span(generators: Iterable[int]) -> Words:
    """All sums of ``generators``."""
    words = np.zeros(1, np.uint64)
    for generator in generators:
        words = np.concatenate([words, words ^ np.uint64(generator)])
    return words


def random_code(n: int, distance: int, rng: np.random.Generator) -> LinearCode:
    """A random code that cannot be extended by a further dimension, as far as is tried, or is large enough.

    Every other one prefers generators that keep all weights divisible by 4: such codes (Golay's is one) are dense
    at distances divisible by 4.
    """
    code = LinearCode(n)
    doubly_even = bool(rng.integers(2))
    while len(code.words) < _MOST_WORDS:
        fit, doubly = [np.zeros(0, np.uint64)], [np.zeros(0, np.uint64)]
        for cosets in _some(code, code.invariant_cosets()[1:], rng):
            weights = weight(code.words ^ cosets[:, None])
            apart = weights.min(axis=1) >= distance
            fit.append(cosets[apart])
            doubly.append(cosets[apart & np.all(weights % 4 == 0, axis=1)])
        preferred = np.concatenate(doubly if doubly_even and any(map(len, doubly)) else fit)
        if not len(preferred):
            break
        code.add(int(preferred[rng.integers(len(preferred))]))
    return code


def _some(code: LinearCode, cosets: Words, rng: np.random.Generator) -> Iterator[Words]:
    """``cosets`` of a code, a block at a time; a random part of them where all have too many words."""
    most = max(1, _MOST_EXAMINED // len(code.words))
    if len(cosets) > most:
        cosets = np.sort(rng.choice(cosets, most, replace=False))
    step = max(1, _WORDS_AT_A_TIME // len(code.words))
    for first in range(0, len(cosets), step):
        yield cosets[first : first + step]


def best_coset(code: LinearCode, distance: int, rng: np.random.Generator) -> Words:
    """The markers of the coset of ``code`` that has most, one word of each four rotations."""
    best, most = -1, np.zeros(0, np.uint64)
    for cosets in _some(code, code.invariant_cosets(), rng):
        words = code.words ^ cosets[:, None]
        counts = np.sum(cuttable(words.reshape(-1), code.n).reshape(words.shape), axis=1)
        if (found := int(counts.max())) > best:
            best, most = found, words[np.argmax(counts)]
    turned = rotations(most[cuttable(most, code.n)], code.n)
    own = np.min(weight(turned[1:] ^ turned[0]), axis=0)
    return np.unique(turned.min(axis=0)[own >= distance])


def apart_from_negatives(markers: Words, n: int, distance: int) -> Words:
    """A subset of ``markers`` in which each differs in ``distance`` bits or more from the negative of any other.

    Markers with the fewest negatives too close to them are taken first.
    """
    full = np.uint64((1 << n * n) - 1)
    negatives_of = rotations(markers, n) ^ full
    close = np.zeros((len(markers), len(markers)), dtype=bool)
    for turned in negatives_of:
        for first in range(0, len(markers), _AT_A_TIME):
            block = slice(first, first + _AT_A_TIME)
            close[block] |= weight(turned[block, None] ^ markers) < distance
    kept: list[int] = []
    for index in np.argsort(close.sum(axis=1), kind='stable').tolist():
        if not close[index, index] and not np.any(close[index, kept]):
            kept.append(index)
    return markers[np.sort(np.array(kept, dtype=np.int64))]


def search(
    n: int,
    distance: int,
    *,
    seed: int,
    restarts: int,
    signed: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Gray:
    """Cuttable markers of n x n bits; any two, and any marker and its rotations, differ in ``distance`` bits or more.

    Parameters
    ----------
    n : bits along a side, 3 to 8
    distance : least Hamming distance
    seed, restarts : the same numbers give the same markers
    signed : also keep this distance from the negatives of all markers, so that the bits distinguish warm from cold
    progress : called with the number of restarts done and the most markers found so far

    Returns
    -------
    (M, n, n) bits, 1 for white; the stiffest markers (shortest arms) first

    Raises
    ------
    InputError
        A size or distance out of range, or no marker found.
    """
    if not 3 <= n <= 8 or not 1 <= distance <= n * n:
        raise InputError(f'no dictionary of {n} x {n} bits at distance {distance}: 3 to 8 bits, distance 1 to n * n')
    rng = np.random.default_rng(seed)
    best = np.zeros(0, np.uint64)
    for done in range(1, restarts + 1):
        markers = best_coset(random_code(n, distance, rng), distance, rng)
        markers = apart_from_negatives(markers, n, distance) if signed else markers
        best = markers if len(markers) > len(best) else best
        if progress is not None:
            progress(done, len(best))
    if not len(best):
        raise InputError(f'no cuttable marker of {n} x {n} bits at distance {distance} found; try more restarts')
    bits = unpack(best, n)
    arms = [examine(marker).longest_arm for marker in bits]
    return np.asarray(bits[np.argsort(arms, kind='stable')])


def distances(bits: Gray) -> tuple[int, int]:
    """Least Hamming distance between two markers in any rotation, and of a marker to its own rotations.

    Parameters
    ----------
    bits : (M, n, n)
    """
    between = own = bits.shape[-1] ** 2
    for turns in range(4):
        turned = np.rot90(bits, turns, axes=(1, 2))
        for first in range(0, len(bits), _AT_A_TIME):
            differing = _differing(bits[first : first + _AT_A_TIME], turned)
            itself = np.arange(len(differing)), first + np.arange(len(differing))
            if turns:
                own = min(own, int(differing[itself].min()))
            differing[itself] = between
            between = min(between, int(differing.min()))
    return between, own


def _differing(bits: Gray, others: Gray) -> Float32Array:
    """Hamming distances (A, B) of patterns (A, n, n) and (B, n, n)."""
    # Of signs the scalar product is the number of equal bits less that of differing ones.
    signs, of_others = (1.0 - 2.0 * b.reshape(len(b), -1).astype(np.float32) for b in (bits, others))
    return np.asarray(0.5 * (signs.shape[1] - signs @ of_others.T), dtype=np.float32)


def _least_differing(bits: Gray, others: Gray) -> Float32Array:
    """The least :func:`_differing` (A, B) of all rotations of the ``others``."""
    turned = [_differing(bits, np.rot90(others, turns, axes=(1, 2))) for turns in range(4)]
    return np.asarray(np.min(turned, axis=0), dtype=np.float32)


def negatives(bits: Gray, closer_than: int) -> list[tuple[int, int, int]]:
    """Pairs of markers, and the distance of one from the negative of the other: the least over the rotations.

    Parameters
    ----------
    bits : (M, n, n)
    closer_than : only pairs that differ in fewer bits
    """
    differing = _least_differing(bits, 1 - bits)
    pairs = np.argwhere(np.triu(differing < closer_than))
    return [(int(a), int(b), int(differing[a, b])) for a, b in pairs]


def mirror_images(bits: Gray, correctable: int) -> list[tuple[int, int]]:
    """Pairs of markers that read as each other in a mirror, or of a marker with itself.

    Parameters
    ----------
    bits : (M, n, n)
    correctable : wrong bits that still name a marker
    """
    pairs = np.argwhere(np.triu(_least_differing(bits[:, :, ::-1], bits) <= correctable))
    return [(int(a), int(b)) for a, b in pairs]


def windows(bits: Gray) -> list[int]:
    """Which of the markers (M, n, n) are a single light rectangle, as a window in a dark panel is."""
    rows, columns = bits.max(axis=2), bits.max(axis=1)
    filled = (bits == rows[:, :, None] * columns[:, None, :]).all(axis=(1, 2))
    # Where light cells begin along either axis.
    once = [(np.diff(lit.astype(np.int8), axis=1, prepend=0) == 1).sum(axis=1) == 1 for lit in (rows, columns)]
    return [int(k) for k in np.flatnonzero(filled & once[0] & once[1])]
