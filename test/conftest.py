"""Settings of all tests: checked message fields, one DDS domain a worker, hypothesis profiles."""

import os
from pathlib import Path

# Before any message is imported: without it a wrong type in a field is published as garbage.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
_WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
os.environ['ROS_DOMAIN_ID'] = str(90 + _WORKER % 11)

import cv2  # noqa: E402
import hypothesis  # noqa: E402
import pytest  # noqa: E402

cv2.setNumThreads(1)
hypothesis.settings.register_profile('default', derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile('default')


@pytest.fixture(scope='session')
def real_data():
    """Folder of the real data; a test that needs it is skipped where it isn't there."""
    folder = os.environ.get('THERMAL_FIDUCIAL_DATA')
    if not folder:
        pytest.skip('THERMAL_FIDUCIAL_DATA is not set: no real data')
    return Path(folder)
