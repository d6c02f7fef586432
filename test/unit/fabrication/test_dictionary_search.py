from itertools import combinations
from pathlib import Path
import re
import shlex
import tracemalloc

import numpy as np
import pytest
from support.opencv import opencv_dictionary

from thermal_fiducial.cli.main import main
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.bit_patterns import cuttable, pack, rotate, unpack, weight
from thermal_fiducial.fabrication.cuttability import examine
from thermal_fiducial.fabrication.dictionary_search import (
    apart_from_negatives,
    distances,
    mirror_images,
    negatives,
    random_code,
    search,
    windows,
)
from thermal_fiducial.files.dictionary import load_dictionary, packaged
from thermal_fiducial.files.dictionary import PACKAGED as FOLDER

#: Packaged dictionary to bits along a side, least number of markers, distance.
PACKAGED = {
    'STENCIL_4X4_16': (4, 16, 6),
    'STENCIL_4X4_100': (4, 80, 4),
    'STENCIL_5X5_100': (5, 72, 8),
    'STENCIL_6X6_100': (6, 50, 12),
    'STENCIL_4X4_80_SIGNED': (4, 80, 4),
    'STENCIL_5X5_100_SIGNED': (5, 100, 8),
}


def turned(rows):
    """A marker as strings, turned by 90 degrees."""
    return [''.join(row[column] for row in rows) for column in reversed(range(len(rows)))]


def differing(a, b):
    return sum(x != y for x, y in zip(''.join(a), ''.join(b), strict=True))


def falls_apart(rows):
    """Whether acrylic ('0') comes off, by following cells one by one: shares nothing with the code under test."""
    n = len(rows)
    acrylic = {(r, c) for r in range(-1, n + 1) for c in range(-1, n + 1) if not (0 <= r < n and 0 <= c < n)}
    acrylic |= {(r, c) for r in range(n) for c in range(n) if rows[r][c] == '0'}
    seen, waiting = {(-1, -1)}, [(-1, -1)]
    while waiting:
        r, c = waiting.pop()
        for cell in {(r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)} & acrylic - seen:
            seen.add(cell)
            waiting.append(cell)
    windows = (rows[r][c : c + 2] + rows[r + 1][c : c + 2] for r in range(n - 1) for c in range(n - 1))
    return seen != acrylic or any(window in ('0110', '1001') for window in windows)


@pytest.mark.parametrize('name', PACKAGED)
def test_packaged_dictionary_keeps_its_promise(name):
    size, least, distance = PACKAGED[name]
    dictionary = load_dictionary(name)
    markers = [[''.join(map(str, row)) for row in bits] for bits in dictionary.bits.tolist()]
    assert dictionary.bits.shape[1:] == (size, size)
    assert dictionary.correctable == (distance - 1) // 2
    assert len(markers) >= least
    assert not any(falls_apart(rows) for rows in markers)
    all_turns = []
    for rows in markers:
        turns = [rows]
        for _ in range(3):
            turns.append(turned(turns[-1]))
        assert min(differing(rows, other) for other in turns[1:]) >= distance
        all_turns.append(turns)
    assert min(differing(a[0], turn) for a, b in combinations(all_turns, 2) for turn in b) >= distance


def negative(rows):
    return [''.join('10'[int(bit)] for bit in row) for row in rows]


@pytest.mark.parametrize(('name', 'distance'), [('STENCIL_4X4_80_SIGNED', 4), ('STENCIL_5X5_100_SIGNED', 8)])
def test_bits_of_signed_markers_distinguish_warm_from_cold(name, distance):
    markers = [[''.join(map(str, row)) for row in bits] for bits in load_dictionary(name).bits.tolist()]
    for rows in markers:
        turns = [negative(rows)]
        for _ in range(3):
            turns.append(turned(turns[-1]))
        assert min(differing(other, turn) for other in markers for turn in turns) >= distance


def test_check_names_markers_that_are_negatives_of_one_another(capsys):
    # Marker 0 turned by no, one, two or three quarters and inverted: one of the 100 is that.
    bits = load_dictionary('STENCIL_4X4_100').bits
    inverted = [1 - np.rot90(bits[0], turns) for turns in range(4)]
    partners = [key for key, other in enumerate(bits) if any(np.array_equal(other, turn) for turn in inverted)]
    pairs = negatives(bits, 4)
    assert [b for a, b, apart in pairs if a == 0 and apart == 0] == partners
    first = pairs[0][:2]
    assert main(['markers', 'check', '--mount', 'none', '--ids', ','.join(map(str, first))]) == 0
    printed = capsys.readouterr().out
    assert f'marker {first[0]} and the negative of {first[1]} differ in 0 bits' in printed
    assert 'use STENCIL_4X4_80_SIGNED or STENCIL_5X5_100_SIGNED, which have none' in printed
    assert main(['markers', 'check', '--mount', 'none', '--dictionary', 'STENCIL_4X4_80_SIGNED', '--ids', '0-5']) == 0
    assert 'negative' not in capsys.readouterr().out


def test_negatives_that_bits_distinguish_are_not_said_to_be_alike(capsys):
    """Of markers 8 bits away from a negative it said that only the border shows their polarity."""
    assert main(['markers', 'check', '--mount', 'none', '--dictionary', 'STENCIL_6X6_100', '--ids', '0,35']) == 0
    printed = capsys.readouterr().out
    assert 'marker 0 and the negative of 35 differ in 8 bits' in printed
    assert 'nearer to a negative than markers to one another (12 bits)' in printed
    assert 'only the border' not in printed


def test_markers_that_a_mirror_turns_into_themselves_or_one_another():
    """One by one, without correlations: a marker, reversed and turned, against each other one."""
    dictionary = load_dictionary('STENCIL_4X4_80_SIGNED')
    bits, expected = dictionary.bits, []
    for a, marker in enumerate(bits):
        turns = [np.rot90(np.fliplr(marker), turn) for turn in range(4)]
        for b, other in enumerate(bits[a:], a):
            if min(np.count_nonzero(turn != other) for turn in turns) <= dictionary.correctable:
                expected.append((a, b))
    assert {a == b for a, b in expected} == {True, False}
    assert mirror_images(bits, dictionary.correctable) == expected


@pytest.mark.parametrize('name', ['STENCIL_4X4_100', 'DICT_4X4_50'])
def test_the_documents_name_the_markers_that_may_be_read_in_a_mirror(name):
    dictionary = load_dictionary(name)
    page = (Path(__file__).resolve().parents[3] / 'doc' / 'markers.md').read_text(encoding='utf-8')
    (section,) = re.findall(
        r'^### Markers that are like their image in a mirror$(.*?)^```', page, re.MULTILINE | re.DOTALL
    )
    (sentences,) = re.findall(rf'In `{name}`([^.]*)\.', section)
    own, _, two = sentences.partition(';')
    listed = [(int(a), int(a)) for a in re.findall(r'\d+', own)]
    listed += [(int(a), int(b)) for a, b in re.findall(r'(\d+) and (\d+)', two)]
    assert sorted(listed) == mirror_images(dictionary.bits, dictionary.correctable)


def test_chosen_markers_that_may_be_read_in_a_mirror_are_named(capsys, tmp_path):
    arguments = ['--mount', 'none', '--formats', 'svg', '--out', str(tmp_path), '--ids', '6,49,57,74']
    assert main(['markers', 'make', *arguments]) == 0
    assert capsys.readouterr().err == (
        'warning: in a mirror (metal, glass, a wet floor) these markers may be read: 6 as itself, 49 as 57\n'
    )
    # Those of the documents' examples.
    assert main(['markers', 'check', '--mount', 'none', '--ids', '23-30']) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(
    ('name', 'expected'),
    [('DICT_4X4_50', [17]), ('STENCIL_4X4_100', [22]), ('STENCIL_4X4_80_SIGNED', [13]), ('STENCIL_5X5_100', [])],
)
def test_markers_that_are_a_window_in_a_panel_are_found(name, expected):
    """One by one: the light cells fill the rectangle about them."""
    dictionary, found = load_dictionary(name), []
    for marker_id, bits in enumerate(dictionary.bits):
        rows, columns = np.nonzero(bits)
        if len(rows) == (np.ptp(rows) + 1) * (np.ptp(columns) + 1):
            found.append(marker_id)
    assert windows(dictionary.bits) == found == expected


def test_a_chosen_marker_that_is_a_window_in_a_panel_is_named(capsys):
    assert main(['markers', 'check', '--mount', 'none', '--ids', '22,23']) == 0
    assert capsys.readouterr().err == 'warning: a light window in a dark panel may be read as 22\n'


def test_check_names_a_marker_that_looks_the_same_upside_down(capsys):
    assert main(['markers', 'check', '--dictionary', 'DICT_ARUCO_ORIGINAL', '--ids', '1022,1023']) == 0
    assert capsys.readouterr().err == (
        'warning: marker 1023 of DICT_ARUCO_ORIGINAL looks the same upside down, shows no pose and is not detected\n'
        'warning: in a mirror (metal, glass, a wet floor) these markers may be read: 1023 as itself\n'
        'warning: a light window in a dark panel may be read as 1023\n'
    )


def test_few_markers_of_a_dictionary_are_as_near_to_negatives_as_in_the_whole(capsys):
    """Measured by the distance of those chosen, marker 0 alone was like its own negative, 8 bits away."""
    assert main(['markers', 'check', '--mount', 'none', '--ids', '0']) == 0
    printed = capsys.readouterr().out
    assert 'negative' not in printed
    assert 'between markers' not in printed


@pytest.mark.parametrize('name', ['STENCIL_4X4_16', 'STENCIL_4X4_100'])
def test_packaged_dictionaries_are_reproduced_by_their_commands(name, tmp_path):
    dictionary = load_dictionary(name)
    packaged = (FOLDER / f'{name}.yaml').read_text()
    arguments = packaged.splitlines()[0].split()[5:]
    out = tmp_path / f'{name}.yaml'
    assert main(['markers', 'dictionary', str(out), *arguments]) == 0
    assert out.read_text() == packaged
    assert len(dictionary.bits) == len(load_dictionary(out).bits)


def test_the_command_in_a_dictionary_is_one_of_a_shell(tmp_path):
    out = tmp_path / 'my own.yaml'
    assert main(['markers', 'dictionary', str(out), '--distance', '6', '--restarts', '5']) == 0
    command = shlex.split(out.read_text().splitlines()[0].removeprefix('# '))
    assert command[:4] == ['thermal-fiducial', 'markers', 'dictionary', 'my own.yaml']


def test_opencv_reads_the_packaged_markers():
    dictionary = load_dictionary('STENCIL_5X5_100')
    theirs = opencv_dictionary(dictionary)
    for marker_id, bits in enumerate(dictionary.bits):
        turned_bits = np.rot90(bits, marker_id % 4)
        damaged = turned_bits.copy()
        damaged[0, 0] ^= 1
        found, identified, _ = theirs.identify(damaged, 0.6)[:3]
        assert found
        assert identified == marker_id


def test_code_is_invariant_and_far_apart():
    code = random_code(4, 6, np.random.default_rng(3))
    assert weight(code.words[1:]).min() >= 6
    assert set(rotate(code.words, 4).tolist()) == set(code.words.tolist())


def test_words_agree_with_bits():
    rng = np.random.default_rng(5)
    bits = rng.integers(0, 2, (200, 5, 5), dtype=np.uint8)
    words = pack(bits)
    assert np.array_equal(unpack(words, 5), bits)
    assert np.array_equal(unpack(rotate(words, 5), 5), np.rot90(bits, axes=(1, 2)))
    assert np.array_equal(weight(words), bits.sum(axis=(1, 2)))
    # 5 x 5 random patterns are rarely cuttable; smoother ones are needed to see both answers.
    smooth = np.repeat(np.repeat(rng.integers(0, 2, (200, 3, 3), dtype=np.uint8), 2, axis=1), 2, axis=2)
    expected = [examine(marker).cuttable for marker in smooth]
    assert 0 < sum(expected) < len(expected)
    assert cuttable(pack(smooth), 6).tolist() == expected


def test_search_depends_on_its_seed_only():
    first, again, other = (search(4, 6, seed=seed, restarts=20) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert min(distances(first)) >= 6


def test_distances_of_many_markers_take_little_memory():
    bits = unpack(np.random.default_rng(1).integers(0, 1 << 36, 3000, dtype=np.uint64), 6)
    tracemalloc.start()
    distances(bits)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # A block of 256 x 3000 numbers is 3 MB, of which some are made on the way; all pairs bit by bit were 324 MB.
    assert most < 30e6


def _most_memory(work):
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_search_takes_little_memory():
    """Eight blocks of a million words; all cosets at a time were 0.4 GB here, and ever more at less distance."""
    assert _most_memory(lambda: search(7, 14, seed=1, restarts=1)) < 80e6


def test_negatives_of_many_markers_take_little_memory():
    """One byte a pair, 2 MB, and some blocks of 256 x 1500 words of 3 MB; four numbers a pair were 0.2 GB."""
    markers = np.unique(np.random.default_rng(1).integers(0, 1 << 36, 1500, dtype=np.uint64))
    assert _most_memory(lambda: apart_from_negatives(markers, 6, 12)) < 30e6


@pytest.mark.parametrize(('bits', 'distance'), [(2, 4), (9, 4), (4, 0), (4, 17), (3, 9)])
def test_search_refuses_impossible_sizes_and_distances(bits, distance):
    with pytest.raises(InputError):
        search(bits, distance, seed=1, restarts=2)


@pytest.mark.parametrize(('name', 'bits_apart'), [('STENCIL_4X4_100', 0), ('STENCIL_5X5_100', 1)])
def test_the_documents_name_the_markers_that_are_like_the_negative_of_another(name, bits_apart):
    bits = load_dictionary(name).bits
    page = (Path(__file__).resolve().parents[3] / 'doc' / 'markers.md').read_text(encoding='utf-8')
    (listed,) = re.findall(rf'In `{name}`\s+these\b([^.]*)\.', page)
    pairs = [(int(a), int(b), bits_apart) for a, b in re.findall(r'(\d+)\s+and\s+(\d+)', listed)]
    assert pairs == negatives(bits, distances(bits)[0])


def test_the_documents_have_each_dictionary_of_the_package():
    page = (Path(__file__).resolve().parents[3] / 'doc' / 'markers.md').read_text(encoding='utf-8')
    rows = re.findall(r'^\| `(\w+)` \| (\d+) \| (\d+) \| (\d+) bits? \|$', page, re.MULTILINE)
    assert sorted(name for name, *_ in rows) == sorted(packaged())
    for name, *shown in rows:
        dictionary = load_dictionary(name)
        is_so = [len(dictionary.bits), distances(dictionary.bits)[0], dictionary.correctable]
        assert list(map(int, shown)) == is_so


@pytest.mark.parametrize('name', ['STENCIL_4X4_80_SIGNED', 'STENCIL_5X5_100_SIGNED'])
def test_signed_dictionaries_have_no_such_markers(name):
    bits = load_dictionary(name).bits
    assert negatives(bits, distances(bits)[0]) == []
