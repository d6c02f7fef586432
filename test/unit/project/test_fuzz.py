"""A short run of ``make fuzz``, and inputs that once found something."""

from random import Random

from fuzz import files, messages
from fuzz.jobs import batches
from fuzz.mutations import mutated_bytes
import pytest

#: Inputs by number: other ones than those of the long run begin with.
FIRST = 1_000_000
#: Inputs that have found something once.
FOUND = (
    11,
    488,
    651,
    748,
    932,
    972,
    1012,
    1013,
    1288,
    1968,
    2092,
    2209,
    2228,
    54394,
    60630,
    400129,
    400289,
    9160952,
    9164571,
)


def nothing(target, number):
    pass


@pytest.mark.ros
@pytest.mark.usefixtures('log_level_restored')
# Their own complaints are the libraries' matter: what counts is what comes of them.
@pytest.mark.filterwarnings('ignore')
def test_mutated_messages_harm_nothing():
    assert messages.run(range(FIRST, FIRST + 40), nothing) == []


def test_files_are_good_before_they_are_mutated(tmp_path):
    """What is refused at its first line is not read any further, whatever is changed behind it."""
    for name, (_, read) in files.Targets(tmp_path).readers.items():
        # Point clouds need an extra; commands change their files for each other.
        if not name.startswith(('cloud.', 'map ')):
            read()


@pytest.mark.filterwarnings('ignore')
def test_mutated_files_harm_nothing():
    assert files.run(range(FIRST, FIRST + 40), nothing) == []


@pytest.mark.filterwarnings('ignore')
def test_what_was_found_once_is_mended():
    assert files.run(FOUND, nothing) == []


def test_an_input_follows_from_its_number():
    data = b'format: a\nvalue: 12.5\n' * 20
    assert mutated_bytes(data, Random(5)) == mutated_bytes(data, Random(5))
    assert len({mutated_bytes(data, Random(number)) for number in range(50)}) > 40


def test_every_input_is_in_one_batch():
    numbers = [number for _, batch in batches('messages', 7, 450) for number in batch]
    assert numbers == list(range(7, 457))
