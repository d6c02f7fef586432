"""ament_python package; ``pip install .[ros]`` brings ROS itself from wheels where there is none."""

from pathlib import Path
import re
import sys

from setuptools import find_packages, setup

PACKAGE = 'thermal_fiducial'
NODES = ('tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf', 'thermal_source', 'landing_target')
#: pip makes the command itself; a workspace has it beside the nodes, so this one puts it on the PATH.
ON_PATH = [] if {'bdist_wheel', 'editable_wheel'} & set(sys.argv) else [('bin', ['scripts/thermal-fiducial'])]
VERSION = re.findall(r"(?m)^__version__ = '(.+)'", Path(PACKAGE, '__init__.py').read_text(encoding='utf-8'))[0]


def files(folder: str, pattern: str) -> list[str]:
    """Paths in ``folder``, in a stable order."""
    return sorted(str(path) for path in Path(folder).glob(pattern))


setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed', '**/*.xml', '**/*.yaml', '**/*.html', '**/*.css', '**/*.js']},
    data_files=[
        *ON_PATH,
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', files('config', '*')),
        (f'share/{PACKAGE}/launch', files('launch', '*.launch.py')),
    ],
    install_requires=[
        'numpy>=1.26',
        'scipy',
        # The oldest in CI. Ubuntu's own 4.6 serves too (package.xml); that of pip has no markers.
        'opencv-python-headless>=4.10',
        'filterpy>=2.0.0',
        'pyyaml',
        'rosbags>=0.11',
    ],
    extras_require={
        'ros': ['ros-rclpy[fastrtps]==7.1.6', 'ros-common-interfaces==5.3.6'],
        'cloud': ['small_gicp', 'plyfile', 'pypcd4', 'rich', 'matplotlib'],
        'cameras': ['pyusb'],  # and libusb-1.0-0, for a ThermalGrabber
        'smoother': ['gtsam>=4.3'],  # the reference of the filter's benchmark; brings pytest 9
        'tools': [
            'rich',
            'matplotlib',
            'plotly>=6',
            'jinja2',
            'evo',
            'ezdxf',
            'svgwrite',
            'reportlab',
            'shapely',
            'allantools',
        ],
        'video': ['av'],  # evaluate --video
        'batch': ['distributed>=2024.4'],
        'test': [
            'pytest',
            'svgpathtools',
            'foxglove-sdk',  # knows what the panels of a layout can be given
            'pypdfium2',
            'hypothesis',
            'pytest-benchmark',
            'pytest-xdist',
            'pytest-timeout',
            'pytest-cov',
            'av',
            'psutil',
        ],
        # Pinned: a new version of a linter must not turn an untouched commit red.
        'lint': ['ruff==0.17.6', 'mypy==2.4.1', 'import-linter==2.16', 'types-PyYAML==6.0.12.20261113'],
        'docs': ['mkdocs-material==9.8.1', 'mkdocstrings[python]==1.0.8'],
        'colcon': ['colcon-core', 'colcon-ros', 'colcon-python-setup-py', 'colcon-package-selection', 'colcon-bash'],
    },
    python_requires='>=3.11',
    zip_safe=False,
    license='BSD-3-Clause',
    description='Thermal-inertial localization from acrylic ArUco markers in smoke and fog',
    maintainer='thermal_fiducial maintainers',
    maintainer_email='maintainers@thermal-fiducial.org',
    entry_points={
        'console_scripts': [
            *(f'{node} = {PACKAGE}.nodes.{node}:main' for node in NODES),
            f'thermal-fiducial = {PACKAGE}.__main__:main',
        ],
    },
)
