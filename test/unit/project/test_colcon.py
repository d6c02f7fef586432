"""``colcon build`` makes the four executables that ``ros2 run`` starts, and they run."""

import ast
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
from support.empty_stage import STOPPED
from support.ros_graph import ros_graph
from support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
NODES = ('tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf', 'thermal_source', 'landing_target')
SOURCES = ('package.xml', 'setup.py', 'setup.cfg', 'resource', 'config', 'launch', 'scripts', 'thermal_fiducial')

COLCON = Path(sys.executable).with_name('colcon')
pytestmark = [
    pytest.mark.slow,
    pytest.mark.ros,
    pytest.mark.skipif(not COLCON.exists(), reason="colcon is not installed: pip install '.[colcon]'"),
]


@pytest.fixture(scope='module')
def workspace(tmp_path_factory):
    """A workspace with a copy of the package, built."""
    workspace = tmp_path_factory.mktemp('workspace')
    package = workspace / 'src' / 'thermal_fiducial'
    package.mkdir(parents=True)
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, package / name, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(source, package / name)
    colcon(workspace, 'build')
    return workspace


def executable(workspace, node, *arguments):
    """The command of ``ros2 run``, in a shell that has sourced the workspace."""
    file = workspace / 'install' / 'thermal_fiducial' / 'lib' / 'thermal_fiducial' / node
    return ['bash', '-c', '. install/setup.bash && exec "$0" "$@"', file, *arguments]


def colcon(workspace, *arguments):
    # The folder of this python first, so that colcon's scripts get this interpreter.
    environment = {
        **os.environ,
        'PATH': f'{COLCON.parent}{os.pathsep}{os.environ["PATH"]}',
        'COLCON_HOME': str(workspace),
    }
    done = subprocess.run(
        [COLCON, *arguments],
        cwd=workspace,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_colcon_takes_it_for_an_ament_package(workspace):
    # An invalid package.xml would only downgrade it to a plain Python one, which ros2 run does not find.
    hooks = workspace / 'install' / 'thermal_fiducial' / 'share' / 'thermal_fiducial' / 'hook'
    assert (hooks / 'ament_prefix_path.sh').is_file()


def test_what_is_installed(workspace):
    prefix = workspace / 'install' / 'thermal_fiducial'
    assert {path.name for path in (prefix / 'lib' / 'thermal_fiducial').iterdir()} == {*NODES, 'thermal-fiducial'}
    share = prefix / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'thermal_fiducial').is_file()
    package = share / 'thermal_fiducial'
    for file in ('package.xml', 'config/thermal_fiducial.yaml', 'config/thermal_fiducial.rviz'):
        assert (package / file).is_file()
    assert {path.name for path in (ROOT / 'launch').glob('*.py')} == {p.name for p in (package / 'launch').iterdir()}
    (code,) = prefix.glob('lib/python3*/site-packages/thermal_fiducial')
    for data in ('ros/process/fastdds.xml', 'py.typed'):
        assert (code / data).is_file()


#: All are made in the same way: two show whether it works, the others at night.
AT_ONCE = ('pose_ekf', 'thermal_source')


@pytest.mark.parametrize(
    'node', [*AT_ONCE, *(pytest.param(node, marks=pytest.mark.nightly) for node in NODES if node not in AT_ONCE)]
)
def test_an_executable_runs_until_it_is_asked_to_stop(workspace, node):
    process = subprocess.Popen(
        executable(workspace, node),
        env={**os.environ, 'ROS_LOG_DIR': str(workspace / 'log')},
        cwd=workspace,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        with ros_graph() as graph:
            graph.spin_until(lambda: node in graph.tester.get_node_names() or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode in STOPPED, output


def test_the_commands_are_on_the_path_of_a_sourced_workspace(workspace):
    done = subprocess.run(
        ['bash', '-c', '. install/setup.bash && command -v thermal-fiducial && thermal-fiducial --version'],
        cwd=workspace,
        env={**os.environ, 'PATH': '/usr/bin:/bin'},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    place, version = done.stdout.splitlines()
    assert place == str(workspace / 'install' / 'thermal_fiducial' / 'bin' / 'thermal-fiducial')
    assert version.startswith('thermal-fiducial ')


def test_an_executable_refuses_a_parameter_in_one_line(workspace):
    done = subprocess.run(
        executable(workspace, 'pose_ekf', '--ros-args', '-p', 'gravity:=1.6'),
        cwd=workspace,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith('pose_ekf: parameter gravity')
    assert len(done.stderr.splitlines()) == 1


#: Where rosdep's names differ from what is imported.
KEYS = {
    'yaml': 'python3-yaml',
    'cv2': 'python3-opencv',
    'PIL': 'python3-pil',
    'filterpy': 'python3-filterpy-pip',
    'rosbags': 'python3-rosbags-pip',
    'tf2_ros': 'tf2_ros_py',
}
#: Without a key of rosdep: from pip, for those who cut markers, align clouds or show trajectories; lz4 with rosbags.
FROM_PIP = {
    'small_gicp',
    'plyfile',
    'pypcd4',
    'allantools',
    'dask',
    'distributed',
    'av',
    'evo',
    'plotly',
    'svgwrite',
} | {'lz4'}
#: Of the user's workspace, where they are asked for.
OPTIONAL = {'px4_msgs', 'aruco_opencv_msgs', 'apriltag_msgs', 'vision_msgs', 'foxglove_msgs'}


def test_the_manifest_names_each_package_that_is_imported():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    named = {element.text for element in manifest.iter('exec_depend')}
    imported = set()
    for file in (*(ROOT / 'thermal_fiducial').rglob('*.py'), *(ROOT / 'launch').glob('*.py')):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add(node.module.split('.')[0])
    foreign = imported - set(sys.stdlib_module_names) - FROM_PIP - OPTIONAL - {'thermal_fiducial'}
    assert {'rclpy', 'numpy', 'cv2'} < foreign
    for module in foreign:
        assert {module, f'python3-{module}', KEYS.get(module)} & named, module


@pytest.mark.parametrize('page', ['doc/install.md', '.github/workflows/test.yml'])
def test_rosdep_is_asked_for_nothing_that_it_would_have_pip_install(page):
    """Ubuntu 24.04 refuses that, and with it all that rosdep was to install (its issue 978)."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    from_pip = {element.text for element in manifest.iter('exec_depend') if element.text.endswith('-pip')}
    skipped = (ROOT / page).read_text().partition('--skip-keys')[2].partition('\n')[0]
    assert from_pip == set(skipped.strip(" '").split())
