"""Marker maps on disk: round trip, defaults, clear errors, and no map lost to a kill."""

from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import dump_map, load_map, save_map

HEAD = 'format: thermal_fiducial/marker_map\nversion: 4\nframe_id: hall\ndictionary: DICT_5X5_50\nmarkers:\n'
ENTRY = '  - {id: 2, size: 0.3, fixed: true, position: [1, 2, 3], orientation: [0, 0, 0, 1]}\n'


def some_map():
    rng = np.random.default_rng(1)
    A = 1e-3 * rng.normal(size=(6, 6))
    T = transform(so3_exp([0.3, -0.4, 1.2]), [1.0, -2.0, 0.5])
    return MarkerMap(
        {
            7: MapMarker(7, 0.25, False, T, A @ A.T, 0.07, 12, 1_700_000_000_000_000_001, 1_700_000_000_500_000_002),
            1: MapMarker(1, 0.3, True, np.eye(4), trusted=False),
        },
        frame_id='hall',
        dictionary='DICT_5X5_50',
        version=9,
    )


def test_a_saved_map_is_loaded_as_it_was(tmp_path):
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    loaded = load_map(path)
    assert (loaded.frame_id, loaded.dictionary, loaded.version) == ('hall', 'DICT_5X5_50', 9)
    for marker in some_map().markers.values():
        read = loaded.markers[marker.id]
        # Nine decimals are written of a pose, six digits of a covariance.
        np.testing.assert_allclose(read.T_map_marker, marker.T_map_marker, atol=3e-9)
        np.testing.assert_allclose(read.covariance, marker.covariance, rtol=1e-5, atol=1e-18)
        for name in ('size', 'fixed', 'trusted', 'observations', 'first_seen_ns', 'last_seen_ns'):
            assert getattr(read, name) == getattr(marker, name)
    assert [entry.name for entry in tmp_path.iterdir()] == ['map.yaml']


def test_what_is_left_out_has_defaults(tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(
        'format: thermal_fiducial/marker_map\nmarkers:\n'
        '  - {id: 2, position: [0, 0, 1.2], orientation: [0.5, 0.5, 0.5, 0.5], covariance: ['
        + ', '.join('1e-4' if k % 7 == 0 else '0' for k in range(36))
        + ']}\n  - {id: 3, position: [0, 0, 0], orientation: [0, 0, 0, 1]}\n'
        '  - {id: 4, size: 0.7, position: [0, 0, 0], orientation: [0, 0, 0, 1]}\n'
    )
    loaded = load_map(path, marker_size=0.4, size_overrides={3: 0.5, 4: 0.6})
    assert {key: marker.size for key, marker in loaded.markers.items()} == {2: 0.4, 3: 0.5, 4: 0.7}
    assert not loaded.markers[2].fixed
    assert loaded.markers[2].trusted
    np.testing.assert_array_equal(loaded.markers[2].covariance, 1e-4 * np.eye(6))
    assert loaded.version == 1


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('', 'not a marker map'),
        ('hello', 'not a marker map'),
        ('markers: []', 'format'),
        (HEAD, 'no list of markers'),
        ((HEAD + ENTRY)[:-25], 'not valid YAML'),
        (HEAD + '  - 3\n', 'markers\\[0\\].*is not a marker'),
        (HEAD + ENTRY + ENTRY, 'markers\\[1\\].*marker 2 is there twice'),
        (HEAD + ENTRY.replace('id: 2', 'id: two'), "markers\\[0\\]: id: 'two'"),
        (HEAD + ENTRY.replace('size: 0.3', 'size: -1'), 'marker 2.*size'),
        (HEAD + ENTRY.replace('size: 0.3, ', ''), 'no size'),
        (HEAD + ENTRY.replace('fixed: true', 'fixed: maybe'), 'fixed'),
        (HEAD + ENTRY.replace('[1, 2, 3]', '[1, 2]'), 'position is not a list of 3 numbers'),
        (HEAD + ENTRY.replace('[1, 2, 3]', '[1, 2, .nan]'), 'position is not a list of 3 numbers'),
        (HEAD + ENTRY.replace('[0, 0, 0, 1]', '[0, 0, 0, 0]'), 'no unit quaternion'),
        (HEAD + ENTRY.replace('size: 0.3', 'covariance: [1]'), 'size|36 numbers'),
        (HEAD + ENTRY.replace('size:', 'sise:'), "unknown field 'sise'"),
        (HEAD.replace('hall', '[1]') + ENTRY, 'frame_id'),
    ],
)
def test_a_broken_map_is_refused_with_file_and_entry(tmp_path, text, complaint):
    path = tmp_path / 'map.yaml'
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_covariance_must_be_one(tmp_path):
    path = tmp_path / 'map.yaml'
    for element, complaint in (((0, 1), 'symmetric'), ((0, 0), 'negative')):
        bad = np.eye(6)
        bad[element] = -2.0
        path.write_text(HEAD + ENTRY.replace('size: 0.3', f'size: 0.3, covariance: {bad.ravel().tolist()}'))
        with pytest.raises(InputError, match=complaint):
            load_map(path)


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(InputError, match='nowhere'):
        load_map(tmp_path / 'nowhere.yaml')
    with pytest.raises(InputError, match='gone'):
        save_map(tmp_path / 'gone' / 'map.yaml', some_map())
    (tmp_path / 'binary.yaml').write_bytes(b'\xff\xfe\x00\x81')
    with pytest.raises(InputError, match='binary'):
        load_map(tmp_path / 'binary.yaml')


_WRITER = """
import itertools, sys
from thermal_fiducial.files.marker_map import load_map, save_map
path = sys.argv[1]
old = load_map(path)
print('ready', flush=True)
for old.version in itertools.count(old.version + 1):
    save_map(path, old)
"""


@pytest.mark.slow
def test_no_map_is_lost_to_a_kill(tmp_path):
    """Writers are killed at random moments; each time the file holds one of the maps, whole."""
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    expected = dump_map(some_map()).splitlines()[2:]
    rng = np.random.default_rng(5)
    versions = [load_map(path).version]
    for _ in range(10):
        writer = subprocess.Popen([sys.executable, '-c', _WRITER, str(path)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        assert writer.stdout.readline() == b'ready\n'
        time.sleep(rng.uniform(0.0, 0.2))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        loaded = load_map(path)
        versions.append(loaded.version)
        assert dump_map(loaded).splitlines()[2:] == expected
    assert versions == sorted(versions)
    # The kills must have met writers at work, or nothing was tested.
    assert versions[-1] > versions[0] + 2


def test_an_interrupted_write_leaves_the_old_map(tmp_path, monkeypatch):
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    before = path.read_text()

    def fail(*_):
        raise OSError(28, 'No space left on device')

    for step in ('os.fsync', 'pathlib.Path.replace'):
        monkeypatch.setattr(step, fail)
        with pytest.raises(InputError, match='No space left'):
            save_map(path, MarkerMap())
        monkeypatch.undo()
        assert path.read_text() == before
        assert [entry.name for entry in Path(tmp_path).iterdir()] == ['map.yaml']
