import numpy as np
import pytest

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.trajectory_file import load_tum, save_tum, tum_line

STAMPS = [1_700_000_000_000_000_001, 1_700_000_000_005_000_000, 1_700_000_001_999_999_999]


def test_stamps_survive_to_the_nanosecond(tmp_path):
    positions, quaternions = np.arange(9.0).reshape(3, 3) / 7, np.tile([0.5, -0.5, 0.5, 0.5], (3, 1))
    save_tum(tmp_path / 'a.tum', STAMPS, positions, quaternions)
    stamps, p, q = load_tum(tmp_path / 'a.tum')
    assert stamps.tolist() == STAMPS
    # Nine decimals are written.
    np.testing.assert_allclose(p, positions, atol=1e-9)
    np.testing.assert_allclose(q, quaternions, atol=1e-9)


def test_line():
    assert tum_line(5_000_000_012, (1, 2, -3), (0, 0, 0, 1)) == (
        '5.000000012 1.000000000 2.000000000 -3.000000000 0.000000000 0.000000000 0.000000000 1.000000000'
    )


def test_reads_comments_commas_exponents_and_normalises(tmp_path):
    (tmp_path / 'a.tum').write_text('# stamp x y z qx qy qz qw\n\n1.5e3, 1,2,3, 0,0,0,2\n1501 1 2 3 0 0 2 0\n')
    stamps, _, q = load_tum(tmp_path / 'a.tum')
    assert stamps.tolist() == [1_500_000_000_000, 1_501_000_000_000]
    np.testing.assert_array_equal(q, [[0, 0, 0, 1], [0, 0, 1, 0]])


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ('', 'no poses'),
        ('# only\n', 'no poses'),
        ('1 2 3\n', 'line 1: 3 values'),
        (',\n', 'line 1: not numbers'),
        ('1 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n', 'line 2: not numbers'),
        ('1 0 0 nan 0 0 0 1\n', 'line 1'),
        ('inf 0 0 0 0 0 0 1\n', 'line 1'),
        ('nan 0 0 0 0 0 0 1\n', 'line 1'),
        ('1 0 0 0 0 0 0 0\n', 'no length'),
        ('# timestamp tx ty tz qw qx qy qz\n1 0 0 0 1 0 0 0\n', 'line 1: qw before qx'),
        ('# c\n2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n', 'line 3: the stamp goes back'),
    ],
)
def test_broken_files(tmp_path, text, says):
    (tmp_path / 'a.tum').write_text(text)
    with pytest.raises(InputError, match=says):
        load_tum(tmp_path / 'a.tum')


def test_saving_where_nothing_can_be_written_is_refused(tmp_path):
    with pytest.raises(InputError):
        save_tum(tmp_path / 'no' / 'folder', [], np.zeros((0, 3)), np.zeros((0, 4)))
