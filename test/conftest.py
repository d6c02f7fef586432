"""Settings of all tests: checked message fields, a DDS domain for each test process, hypothesis profiles."""

import gc
import os
from pathlib import Path

# Before any message is imported: without it a wrong type in a field is published as garbage.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import cv2
import hypothesis
import pytest
from rclpy.logging import LoggingSeverity, set_logger_level
from support import small_bag
from support.ros_graph import ros_graph

from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.ros.process.run import use_transport_profile

cv2.setNumThreads(1)
_domain = own_domain()
os.environ['ROS_DOMAIN_ID'] = str(_domain.__enter__())
# Fast DDS reads profiles once a process: whichever test comes first, replays later on need theirs.
use_transport_profile()
hypothesis.settings.register_profile('default', derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile('default')


def pytest_collection_finish():
    """What has been imported stays: going through it again and again took a fifteenth of the tests' time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


#: Where ``make coverage`` traces the core: its own tests run 98 % of it, and those of other layers hardly more.
_TRACED = [Path(__file__).parent / folder for folder in ('unit/core', 'property')]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Trace only what runs more of the core, as tracing doubles the time of all Python."""
    plugin = item.config.pluginmanager.get_plugin('_cov')
    control = getattr(plugin, 'cov_controller', None)
    if control is None or _runs_more_of_the_core(item):
        return (yield)
    control.pause()
    try:
        return (yield)
    finally:
        control.resume()


def _runs_more_of_the_core(item):
    """Whether it is a test of the core, not one of many flights, and with its first parameters: others run the same."""
    of_the_core = any(item.path.is_relative_to(folder) for folder in _TRACED)
    first = not hasattr(item, 'callspec') or not any(item.callspec.indices.values())
    return of_the_core and first and item.get_closest_marker('slow') is None


@pytest.fixture(scope='session')
def measured():
    """Take (what, goal, value) of a test on real data; ``make tables`` asks for them as a table of the README."""
    rows = []
    yield lambda *row: rows.append(row)
    if rows and os.environ.get('THERMAL_FIDUCIAL_TABLES'):
        table = Path(__file__).resolve().parents[1] / 'doc' / 'tables' / 'real.md'
        lines = [('real data', 'goal', 'measured'), ('---', '---', '---'), *rows]
        table.write_text(''.join(f'| {" | ".join(map(str, line))} |\n' for line in lines))


@pytest.fixture(scope='session')
def real_data():
    """Folder of the real data; a test that needs it is skipped where it isn't there."""
    folder = os.environ.get('THERMAL_FIDUCIAL_DATA')
    if not folder:
        pytest.skip('THERMAL_FIDUCIAL_DATA is not set: no real data')
    return Path(folder)


@pytest.fixture
def graph():
    """The nodes of a test, in a graph of their own."""
    with ros_graph() as graph:
        yield graph


@pytest.fixture
def map_file(tmp_path):
    """A map of the four markers of the small bag."""
    return small_bag.side_files(tmp_path)[0]


@pytest.fixture
def log_level_restored():
    """For tests whose nodes are silent: the level is that of the process, and later tests read the console."""
    yield
    set_logger_level('', LoggingSeverity.INFO)
