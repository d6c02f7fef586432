"""The names that the package offers, and where its version stands."""

import ast
from importlib import import_module
from pathlib import Path
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

import thermal_fiducial

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize('name', thermal_fiducial.__all__)
def test_each_name_is_there_and_documented(name):
    value = getattr(thermal_fiducial, name)
    assert value.__name__ == name
    assert value.__doc__.strip()
    assert f'thermal_fiducial.{name}\n' in (ROOT / 'doc' / 'api.md').read_text()


def test_type_checkers_see_the_names_that_are_imported():
    tree = ast.parse(Path(thermal_fiducial.__file__).read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    declared = {alias.name: node.module for node in block.body for alias in node.names}
    assert sorted(declared) == sorted(thermal_fiducial.__all__)
    for name, module in declared.items():
        # Imported here: whether another test has done so depends on which of them share a process.
        assert getattr(import_module(module), name) is getattr(thermal_fiducial, name)


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Pipelin'"):
        _ = thermal_fiducial.Pipelin


def test_the_package_alone_loads_nothing_heavy():
    code = 'import sys, thermal_fiducial; print({"numpy", "cv2", "rclpy", "scipy"} & sys.modules.keys())'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == 'set()'


def test_the_library_needs_no_ros():
    code = 'import sys; from thermal_fiducial import *; print([name for name in sys.modules if name == "rclpy"])'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'


def test_one_version():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.findtext('version') == thermal_fiducial.__version__
    assert f'## {thermal_fiducial.__version__}' in (ROOT / 'doc' / 'CHANGELOG.md').read_text()
    printed = subprocess.run(
        [sys.executable, 'setup.py', '--version'], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert printed.stdout.split()[-1] == thermal_fiducial.__version__
