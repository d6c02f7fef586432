"""The scripts of ``doc/examples`` do what they say."""

from pathlib import Path
import re
import runpy
import sys

import cv2
import numpy as np
import pytest
from support import small_bag

from thermal_fiducial import InputError, load_map
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.trajectory_file import load_tum, save_tum

FOLDER = Path(__file__).resolve().parents[3] / 'doc' / 'examples'
SCRIPTS = sorted(path.stem for path in FOLDER.glob('*.py'))
# Pictures that are flat and warped into place: fine for whether a script works, no measure of accuracy.
TOLERANCE_M = 0.05


def run(script, *arguments):
    runpy.run_path(str(FOLDER / f'{script}.py'))['main'](*map(str, arguments))


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A bag of two seconds with its parameters, a map of all markers and one of the first alone."""
    folder = tmp_path_factory.mktemp('examples')
    small_bag.recording(2.0).write(folder / 'bag')
    small_bag.side_files(folder, ids=(0,))
    (folder / 'map.yaml').rename(folder / 'start.yaml')
    small_bag.side_files(folder, ids=small_bag.CENTRES)
    return folder


def assert_near_the_truth(path):
    stamps, positions, _ = load_tum(path)
    assert len(stamps) > 300  # of 400 IMU samples, the first of which come before the filter has started
    truth = [small_bag.true_pose((stamp - small_bag.START_NS) * 1e-9)[:3, 3] for stamp in stamps]
    assert np.max(np.linalg.norm(positions - truth, axis=1)) < TOLERANCE_M


def test_there_are_five_of_at_most_40_lines():
    assert len(SCRIPTS) == 5
    for script in SCRIPTS:
        assert len((FOLDER / f'{script}.py').read_text().splitlines()) <= 40


def test_each_is_in_the_document():
    text = (FOLDER.parent / 'examples.md').read_text()
    assert all(f'examples/{script}.py' in text for script in SCRIPTS)


@pytest.mark.parametrize('script', SCRIPTS)
@pytest.mark.parametrize('words', [[], ['one', 'two', 'three', 'four', 'five']])
def test_wrong_arguments_are_answered_by_one_line_that_names_them_all(monkeypatch, script, words):
    path = FOLDER / f'{script}.py'
    (usage,) = re.findall(r'^""".*``(python .*?)``', path.read_text())
    monkeypatch.setattr(sys, 'argv', [str(path), *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name='__main__')
    assert ended.value.code == f'usage: {usage}'


def test_detect_in_picture(tmp_path, capsys):
    cv2.imwrite(str(tmp_path / 'frame.png'), small_bag.frame(small_bag.true_pose(0.5), np.random.default_rng(0)))
    save_camera(tmp_path / 'camera.yaml', small_bag.CAMERA)
    run('detect_in_picture', tmp_path / 'frame.png', tmp_path / 'camera.yaml')
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(':')[0] for line in lines] == ['marker 0', 'marker 1', 'marker 2', 'marker 3']


def test_a_picture_that_is_not_there_is_named(tmp_path):
    save_camera(tmp_path / 'camera.yaml', small_bag.CAMERA)
    with pytest.raises(InputError, match=r'frame\.png: cannot read it'):
        run('detect_in_picture', tmp_path / 'frame.png', tmp_path / 'camera.yaml')


def test_localize_bag(folder, capsys):
    run('localize_bag', folder / 'bag', folder / 'params.yaml', folder / 'map.yaml', folder / 'pose.tum')
    assert capsys.readouterr().out == f'{folder / "pose.tum"}: tracking\n'
    assert_near_the_truth(folder / 'pose.tum')


def test_build_map(folder):
    run('build_map', folder / 'bag', folder / 'params.yaml', folder / 'start.yaml', folder / 'built.yaml')
    built = load_map(folder / 'built.yaml').markers
    assert built.keys() == small_bag.CENTRES.keys()
    for marker_id, centre in small_bag.CENTRES.items():
        assert np.linalg.norm(built[marker_id].T_map_marker[:3, 3] - centre) < TOLERANCE_M


def test_fuse_poses(folder):
    stamps = small_bag.START_NS + np.arange(10, 290) * 10_000_000
    poses = np.array([small_bag.true_pose((stamp - small_bag.START_NS) * 1e-9) for stamp in stamps])
    quaternions = np.array([quaternion_from_rotation(T[:3, :3]) for T in poses])
    save_tum(folder / 'mine.tum', stamps, poses[:, :3, 3], quaternions)
    run('fuse_poses', folder / 'bag', folder / 'mine.tum', folder / 'fused.tum')
    assert_near_the_truth(folder / 'fused.tum')


def test_plot_run(tmp_path):
    stamps = small_bag.START_NS + np.arange(50) * 20_000_000
    poses = np.array([small_bag.true_pose(k / 50) for k in range(50)])
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (50, 1))
    save_tum(tmp_path / 'fused.tum', stamps, poses[:, :3, 3], quaternions)
    save_tum(tmp_path / 'fiducial.tum', stamps[5:], poses[5:, :3, 3], quaternions[5:])
    run('plot_run', tmp_path, tmp_path / 'run.png')
    picture = cv2.imread(str(tmp_path / 'run.png'))
    assert picture.std() > 5.0  # an empty page has none
