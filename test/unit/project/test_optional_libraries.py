"""What may be missing on a robot: the core runs without ROS, the commands without the tools they don't need."""

import ast
from pathlib import Path
import pkgutil
import subprocess
import sys

import pytest
from support.run_folders import make_run
from support.waiting import PATIENCE_S

import thermal_fiducial.core
from thermal_fiducial.files.packages import remedy

WITHOUT_ROS = ('rclpy', 'sensor_msgs', 'geometry_msgs', 'rosbags', 'yaml')
TOOLS = ('matplotlib', 'jinja2', 'plotly', 'evo', 'rich', 'scipy', 'ezdxf', 'PIL')

# filterpy itself imports scipy and matplotlib, so in the core only ROS and files are hidden.
BLOCK = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {names!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)
sys.meta_path.insert(0, Hidden())
"""


def python(code, hidden, *arguments):
    return subprocess.run(
        [sys.executable, '-c', BLOCK.format(names=hidden) + code, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


def test_the_core_imports_without_ros_and_files():
    core = thermal_fiducial.core
    names = [module.name for module in pkgutil.walk_packages(core.__path__, f'{core.__name__}.')]
    result = python('import importlib\nfor name in sys.argv[1:]: importlib.import_module(name)', WITHOUT_ROS, *names)
    assert result.returncode == 0, result.stderr


COMMAND = 'from thermal_fiducial.cli.main import main\nsys.exit(main(sys.argv[1:]))'


@pytest.fixture(scope='module')
def run_folder(tmp_path_factory):
    return str(make_run(tmp_path_factory.mktemp('runs') / 'run', seconds=2.0, gap=(1.0, 1.4), with_output=False))


def test_measures_need_no_tools(run_folder):
    result = python(COMMAND, TOOLS, 'evaluate', run_folder, '--json', '--no-report')
    assert result.returncode == 0, result.stderr
    assert '"position_rms_mm"' in result.stdout


@pytest.mark.parametrize('options', [(), ('--no-report',)])
def test_a_missing_tool_is_named_in_one_line(run_folder, options):
    result = python(COMMAND, TOOLS, 'evaluate', run_folder, *options)
    assert result.returncode == 2
    assert "pip install '.[tools]' in the package's folder" in result.stderr
    assert result.stderr.count('\n') == 1


def test_a_package_that_is_there_and_broken_is_not_said_to_be_missing(run_folder, tmp_path):
    """Ubuntu's own are, beside NumPy 2 of pip: '--compare needs None' hid it."""
    (tmp_path / 'evo').mkdir()
    (tmp_path / 'evo' / '__init__.py').write_text("raise ImportError('numpy.core.multiarray failed to import')")
    code = f'import sys; sys.path.insert(0, {str(tmp_path)!r}); {COMMAND}'
    result = python(code, (), 'evaluate', run_folder, str(tmp_path), '--compare')
    assert result.stderr.endswith('ImportError: numpy.core.multiarray failed to import\n')
    assert 'needs' not in result.stderr


@pytest.mark.parametrize(
    ('options', 'hidden', 'words'),
    [
        ((), ('plotly',), f'the report needs plotly: {remedy("tools")}, or replay with --no-report'),
        (('--no-report', '--video'), ('av',), f'--video needs PyAV: {remedy("video")}'),
    ],
)
def test_a_replay_names_missing_packages_before_it_begins(tmp_path, monkeypatch, options, hidden, words):
    monkeypatch.setenv('PATH', '')
    arguments = ('replay', str(tmp_path / 'no_bag'), '--out', str(tmp_path / 'run'), *options)
    result = python(COMMAND, hidden, *arguments)
    assert result.returncode == 2
    assert words in result.stderr
    assert result.stderr.count('\n') == 1
    assert not (tmp_path / 'run').exists()


@pytest.mark.parametrize(
    ('hidden', 'options', 'words'),
    [
        (('rclpy', 'sensor_msgs'), (), f'the demo runs the ROS 2 nodes and finds no rclpy: {remedy("ros")}'),
        (('matplotlib',), ('--picture', 'demo.png'), f'--picture needs matplotlib: {remedy("tools")}'),
        (('plotly',), (), f'the report needs plotly: {remedy("tools")}'),
    ],
)
def test_the_demo_names_missing_packages_before_it_begins(tmp_path, hidden, options, words):
    result = python(COMMAND, hidden, 'demo', '--out', str(tmp_path / 'demo'), *options)
    assert result.returncode == 2
    assert result.stderr == f'thermal-fiducial demo: {words}\n'
    assert not (tmp_path / 'demo').exists()


def test_plots_that_cannot_be_drawn_are_refused_before_the_work(tmp_path):
    commands = ('map show map.yaml', 'map align map.yaml --cloud hall.ply', 'markers plan')
    code = f"""
from thermal_fiducial.cli.main import main
for command in {commands}:
    assert main([*command.split(), '--plot', sys.argv[1]]) == 2
"""
    result = python(code, ('matplotlib',), str(tmp_path / 'plot.png'))
    assert result.returncode == 0, result.stderr
    refusal = f'--plot needs matplotlib: {remedy("tools")}'
    assert result.stderr == ''.join(f'thermal-fiducial {command.split()[0]}: {refusal}\n' for command in commands)
    assert result.stdout == ''


def test_drawings_that_cannot_all_be_written_are_not_begun(tmp_path):
    result = python(COMMAND, ('ezdxf', 'reportlab'), 'markers', 'make', '--ids', '1', '--out', str(tmp_path))
    assert result.returncode == 2
    words = f'ezdxf, reportlab missing: {remedy("tools")}, or leave dxf, pdf out of --formats'
    assert result.stderr == f'thermal-fiducial markers: {words}\n'
    assert not list(tmp_path.iterdir())


SLOW = ('scipy.stats', 'scipy.ndimage', 'matplotlib', 'rosbags', 'plotly', 'jinja2', 'rich')
#: What a node that has no pictures does not need either.
OF_SOME = {'pose_ekf': ('cv2', 'scipy', 'xml')}


@pytest.mark.ros
@pytest.mark.parametrize('node', ['tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf'])
def test_a_restarting_node_imports_no_library_that_it_does_not_use(node):
    code = f'import sys, thermal_fiducial.nodes.{node}\nprint(*[name for name in sys.argv[1:] if name in sys.modules])'
    result = python(code, (), *SLOW, *OF_SOME.get(node, ()))
    assert (result.stdout, result.stderr) == ('\n', '')


def test_of_filterpy_its_filter_alone_is_loaded_and_the_rest_stays_to_be_had():
    code = """
from thermal_fiducial.core.filter.kalman import ExtendedKalmanFilter
import numpy as np
assert not any(name.startswith(('filterpy', 'scipy')) for name in sys.modules)
ours = ExtendedKalmanFilter(dim_x=2, dim_z=1)
import filterpy.kalman
whole = filterpy.kalman.ExtendedKalmanFilter(dim_x=2, dim_z=1)
for each in (ours, whole):
    each.P = np.array([[2.0, 0.5], [0.5, 1.0]])
    each.update(np.array([0.3]), lambda x: np.array([[1.0, 0.2]]), lambda x: np.array([0.1]), R=np.eye(1))
# Another library's inverse: the last bits.
assert np.allclose(ours.x, whole.x, rtol=1e-12) and np.allclose(ours.P, whole.P, rtol=1e-12)
assert abs(ours.log_likelihood - whole.log_likelihood) < 1e-9
"""
    result = python(code, ())
    assert result.returncode == 0, result.stderr


def test_a_filterpy_that_is_laid_out_otherwise_is_loaded_whole(tmp_path):
    (tmp_path / 'filterpy').mkdir()
    (tmp_path / 'filterpy' / '__init__.py').write_text('')
    (tmp_path / 'filterpy' / 'kalman.py').write_text('class ExtendedKalmanFilter: whole = True')
    code = """
sys.path.insert(0, sys.argv[1])
from thermal_fiducial.core.filter.kalman import ExtendedKalmanFilter
assert ExtendedKalmanFilter.whole and 'filterpy' in sys.modules
"""
    result = python(code, (), str(tmp_path))
    assert result.returncode == 0, result.stderr


#: What the nodes use of OpenCV, each looked up in 4.6, which Ubuntu 24.04 has.
IN_OPENCV_4_6 = """
    BORDER_REFLECT_101 BORDER_REPLICATE CAP_FFMPEG CAP_PROP_CONVERT_RGB CHAIN_APPROX_SIMPLE CMP_LT COLOR_GRAY2BGR CV_32F
    DIST_L2 DIST_LABEL_PIXEL DIST_MASK_5 FONT_HERSHEY_SIMPLEX GaussianBlur IMREAD_ANYDEPTH IMREAD_GRAYSCALE
    IMREAD_IGNORE_ORIENTATION IMREAD_UNCHANGED INTER_AREA INTER_CUBIC INTER_LANCZOS4 INTER_LINEAR LUT MORPH_CLOSE
    MORPH_OPEN REDUCE_AVG REDUCE_SUM RETR_LIST Sobel TERM_CRITERIA_EPS TERM_CRITERIA_MAX_ITER TM_CCOEFF_NORMED
    VideoCapture WARP_INVERSE_MAP
    __version__ absdiff addWeighted approxPolyDP arcLength aruco.getPredefinedDictionary blur circle compare contourArea
    convertScaleAbs convexHull copyMakeBorder cvtColor dilate distanceTransformWithLabels error fillConvexPoly
    findContours fisheye.projectPoints fisheye.undistortPoints getNumThreads getPerspectiveTransform imdecode
    imreadmulti matchTemplate medianBlur morphologyEx perspectiveTransform polylines projectPoints
    putText reduce remap resize setNumThreads split subtract warpAffine warpPerspective
"""


def test_the_nodes_use_nothing_of_opencv_that_ubuntu_has_not():
    package = Path(thermal_fiducial.core.__file__).parents[1]
    files = [file for layer in ('core', 'files', 'cameras', 'ros', 'nodes') for file in (package / layer).rglob('*.py')]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    parts = {ast.unparse(node).removeprefix('cv2.') for node in nodes if _is_of_opencv(node)}
    used = {name for name in parts if not any(other.startswith(f'{name}.') for other in parts)}
    assert 'remap' in used
    assert used <= set(IN_OPENCV_4_6.split())


def _is_of_opencv(node):
    """An attribute of cv2, or of one of its modules."""
    owner = node.value if isinstance(node, ast.Attribute) else None
    if isinstance(owner, ast.Attribute) and owner.attr in ('aruco', 'fisheye'):
        owner = owner.value
    return isinstance(owner, ast.Name) and owner.id == 'cv2'
