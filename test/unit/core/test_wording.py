"""Numbers and nouns agree."""

from thermal_fiducial.core.wording import number_of


def test_one_is_singular():
    words = [number_of(count, 'camera pose') for count in (0, 1, 2)]
    assert words == ['0 camera poses', '1 camera pose', '2 camera poses']
