"""Numbers and nouns agree."""

from thermal_fiducial.core.wording import listed, number_of


def test_one_is_singular():
    words = [number_of(count, 'camera pose') for count in (0, 1, 2)]
    assert words == ['0 camera poses', '1 camera pose', '2 camera poses']


def test_long_lists_end_with_a_number():
    assert [listed(range(count), 2) for count in (1, 2, 3)] == ['0', '0, 1', '0, 1 and 1 more']
