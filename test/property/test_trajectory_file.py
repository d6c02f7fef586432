from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from thermal_fiducial.files.trajectory_file import load_tum, save_tum

numbers = st.floats(-1e4, 1e4)


@given(
    stamps=st.lists(st.integers(0, 2**62), min_size=1, max_size=5).map(sorted),
    position=st.tuples(numbers, numbers, numbers),
    vector=st.tuples(*[st.floats(0.1, 1.0)] * 4),
)
def test_poses_survive_a_file(tmp_path_factory, stamps, position, vector):
    path = tmp_path_factory.getbasetemp() / 'poses.tum'
    quaternion = np.array(vector) / np.linalg.norm(vector)
    save_tum(path, stamps, np.tile(position, (len(stamps), 1)), np.tile(quaternion, (len(stamps), 1)))
    read, positions, quaternions = load_tum(path)
    assert read.tolist() == stamps
    # Nine decimals are written; a thousandth of the last for the doubles that print to it.
    np.testing.assert_allclose(positions[-1], position, atol=0.51e-9, rtol=1e-15)
    np.testing.assert_allclose(quaternions[-1], quaternion, atol=2e-9)
