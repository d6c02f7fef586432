"""Marker maps on disk: round trip, defaults, clear errors, and no map lost to a kill."""

from dataclasses import replace
from functools import partial
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import skew, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.map_format import parse_document, upgraded
from thermal_fiducial.files.marker_map import dump_map, load_map, save_map

HEAD = (
    'format: thermal_fiducial/marker_map\nversion: 1\nrevision: 4\nframe_id: hall\ndictionary: DICT_5X5_50\nmarkers:\n'
)
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
        revision=9,
    )


def test_a_saved_map_is_loaded_as_it_was(tmp_path):
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    loaded = load_map(path)
    assert (loaded.frame_id, loaded.dictionary, loaded.revision) == ('hall', 'DICT_5X5_50', 9)
    for marker in some_map().markers.values():
        read = loaded.markers[marker.id]
        # Nine decimals are written of a pose, nine digits of a covariance.
        np.testing.assert_allclose(read.T_map_marker, marker.T_map_marker, atol=3e-9)
        np.testing.assert_allclose(read.covariance, marker.covariance, rtol=1e-8, atol=1e-18)
        for name in ('size', 'fixed', 'trusted', 'observations', 'first_seen_ns', 'last_seen_ns'):
            assert getattr(read, name) == getattr(marker, name)
    assert [entry.name for entry in tmp_path.iterdir()] == ['map.yaml']


def test_a_map_of_the_largest_dictionary_is_saved_with_all_fields(tmp_path):
    """2,115 markers of tagStandard41h12; what cannot be read back is not written, and a flown map would be lost."""
    flown = {
        key: MapMarker(key, 0.3, False, np.eye(4), 1e-4 * np.eye(6), observations=3, first_seen_ns=1, last_seen_ns=2)
        for key in range(2115)
    }
    save_map(tmp_path / 'map.yaml', MarkerMap(flown))


def test_markers_that_share_nearly_all_of_their_errors_are_saved(tmp_path):
    """Up to 20 m from an anchor that is tilted by 10 mrad, and known to 0.1 mm beside it: 1 in 75 was refused."""
    rng = np.random.default_rng(0)
    markers = {}
    for key in range(300):
        lever = np.vstack([skew(-rng.normal(size=3) * 10.0), np.eye(3)])
        shared = lever @ np.diag(rng.uniform(0.0, 0.01, 3) ** 2) @ lever.T
        markers[key] = MapMarker(key, 0.3, False, np.eye(4), shared + np.diag([1e-4**2] * 3 + [3e-4**2] * 3))
    save_map(tmp_path / 'map.yaml', MarkerMap(markers))
    for marker in load_map(tmp_path / 'map.yaml').markers.values():
        # The own part is known to a tenth, too.
        assert np.linalg.eigvalsh(marker.covariance)[0] > 0.9 * 1e-4**2


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
    assert loaded.revision == 1


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('', 'not a marker map'),
        ('hello', 'not a marker map'),
        ('markers: []', 'format'),
        (HEAD, 'no list of markers'),
        ((HEAD + ENTRY)[:-25], 'not valid YAML'),
        # "found character that cannot start any token" said nothing of what cannot be seen.
        (HEAD + ENTRY.replace('  -', '\t-', 1), 'line 7: not valid YAML: a tab, where YAML takes spaces only'),
        (HEAD + '  - {', 'not valid YAML'),
        (HEAD + '  - 3\n', 'markers\\[0\\].*is not a marker'),
        (HEAD + ENTRY + ENTRY, 'markers\\[1\\].*marker 2 is there twice'),
        (HEAD + ENTRY.replace('id: 2', 'id: two'), "markers\\[0\\]: id: 'two'"),
        (HEAD + ENTRY.replace('size: 0.3', 'size: -1'), 'marker 2.*size'),
        (HEAD + ENTRY.replace('size: 0.3', 'size: 30'), "marker 2.*size: '30' is not a side in metres"),
        (HEAD + ENTRY.replace('size: 0.3, ', ''), 'no size'),
        (HEAD + ENTRY.replace('fixed: true', 'fixed: maybe'), 'fixed'),
        (HEAD + ENTRY.replace('[1, 2, 3]', '[1, 2]'), 'position: not a list of 3 numbers'),
        (HEAD + ENTRY.replace('[1, 2, 3]', '[1, 2, .nan]'), "position\\[2\\]: '.nan' is not a number"),
        (HEAD + ENTRY.replace('[0, 0, 0, 1]', '[0, 0, 0, 0]'), 'no unit quaternion'),
        (HEAD + ENTRY.replace('size: 0.3', 'covariance: [1]'), 'size|36 numbers'),
        (HEAD + ENTRY.replace('size:', 'sise:'), "unknown field 'sise'"),
        (HEAD.replace('hall', '[1]') + ENTRY, 'frame_id'),
        (
            HEAD.replace('version: 1', 'version: 99') + ENTRY,
            'line 2: version: schema 99 is unknown',
        ),
        (HEAD.replace('version: 1\nrevision: 4', 'version: 4') + ENTRY, 'schema 4 is unknown.*map upgrade'),
        (HEAD.replace('revision', 'revsion') + ENTRY, "line 3: unknown field 'revsion'"),
    ],
)
def test_a_broken_map_is_refused_with_file_and_entry(tmp_path, text, complaint):
    path = tmp_path / 'map.yaml'
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('encoding', ['latin-1', 'utf-16'])
def test_a_map_in_another_encoding_is_refused_with_the_line(tmp_path, encoding):
    """A comment with an umlaut is enough: "not a text file" was said of a text."""
    path = tmp_path / 'map.yaml'
    path.write_text(HEAD + '# für die Halle\n' + ENTRY, encoding=encoding)
    line = HEAD.count('\n') + 1 if encoding == 'latin-1' else 1
    with pytest.raises(InputError, match=f'map.yaml: line {line}: no text in UTF-8'):
        load_map(path)


def test_a_covariance_must_be_one(tmp_path):
    path = tmp_path / 'map.yaml'
    for element, complaint in (((0, 1), 'symmetric'), ((0, 0), 'negative')):
        bad = np.eye(6)
        bad[element] = -2.0
        path.write_text(HEAD + ENTRY.replace('size: 0.3', f'size: 0.3, covariance: {bad.ravel().tolist()}'))
        with pytest.raises(InputError, match=complaint):
            load_map(path)


def test_saving_where_nothing_can_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match='gone'):
        save_map(tmp_path / 'gone' / 'map.yaml', some_map())


_WRITER = """
import itertools, sys
from thermal_fiducial.files.marker_map import load_map, save_map
path = sys.argv[1]
old = load_map(path)
old.revision += 1
save_map(path, old)
# From here on it is at work, however long a busy machine took to start it.
print('ready', flush=True)
for old.revision in itertools.count(old.revision + 1):
    save_map(path, old)
"""


@pytest.mark.slow
def test_no_map_is_lost_to_a_kill(tmp_path):
    """Writers are killed at random moments; each time the file holds one of the maps, whole."""
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    expected = dump_map(some_map()).splitlines()[3:]
    rng = np.random.default_rng(5)
    versions = [load_map(path).revision]
    for _ in range(10):
        writer = subprocess.Popen([sys.executable, '-c', _WRITER, str(path)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        assert writer.stdout.readline() == b'ready\n'
        time.sleep(rng.uniform(0.0, 0.2))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        loaded = load_map(path)
        versions.append(loaded.revision)
        assert dump_map(loaded).splitlines()[3:] == expected
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


def test_a_map_from_before_the_revisions_keeps_loading_or_is_upgraded(tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(HEAD.replace('revision: 4\n', '') + ENTRY)
    assert load_map(path).revision == 1
    path.write_text(HEAD.replace('version: 1\nrevision: 4', 'version: 12') + ENTRY)
    assert parse_document(str(path), upgraded(str(path))).revision == 12
    path.write_text(HEAD + ENTRY)
    with pytest.raises(InputError, match='present format already'):
        upgraded(str(path))


@pytest.mark.parametrize('spoilt', [{'size': np.nan}, {'id': -3}, {'T_map_marker': np.full((4, 4), np.inf)}])
def test_what_could_not_be_read_back_is_not_written(tmp_path, spoilt):
    path = tmp_path / 'map.yaml'
    save_map(path, some_map())
    before = path.read_bytes()
    bad = some_map()
    bad.markers[7] = replace(bad.markers[7], **spoilt)
    with pytest.raises(InputError, match='marker 7 of the map: '):
        save_map(path, bad)
    assert path.read_bytes() == before
    # A mapper saves without that check.
    with pytest.raises(InputError, match='not written'):
        dump_map(bad)


def test_a_symbolic_link_stays_one(tmp_path):
    (tmp_path / 'maps').mkdir()
    save_map(tmp_path / 'maps' / 'real.yaml', MarkerMap())
    link = tmp_path / 'map.yaml'
    link.symlink_to('maps/real.yaml')
    save_map(link, some_map())
    assert link.is_symlink()
    assert load_map(tmp_path / 'maps' / 'real.yaml').revision == 9
    assert [entry.name for entry in (tmp_path / 'maps').iterdir()] == ['real.yaml']


def entry(**fields):
    return MapMarker(**({'id': 2, 'size': 0.3, 'fixed': False, 'T_map_marker': np.eye(4)} | fields))


@pytest.mark.parametrize(
    ('fields', 'words'),
    [
        ({'T_map_marker': np.full((4, 4), np.nan)}, 'no finite rotation and translation'),
        ({'T_map_marker': 2.0 * np.eye(4)}, 'no finite rotation and translation'),
        ({'T_map_marker': transform(np.eye(3), [0.0, 1e6, 0.0])}, '1e+06 m away'),
        ({'T_map_marker': np.eye(3)}, 'T_map_marker is a ndarray of shape (3, 3), not a numpy array of shape (4, 4)'),
        ({'T_map_marker': np.eye(4).tolist()}, 'T_map_marker is a list of shape (4, 4)'),
        ({'size': 0.0}, '0.0 is not a side in metres'),
        ({'size': np.nan}, 'nan is not a side in metres'),
        ({'size': '0.3'}, "'0.3' is not a side in metres"),
        ({'covariance': np.full((6, 6), np.nan)}, 'covariance: not finite, or too large'),
        ({'covariance': -np.eye(6)}, 'covariance: has a negative variance'),
        ({'covariance': np.triu(np.ones((6, 6)))}, 'covariance: not symmetric'),
        ({'covariance': np.eye(3)}, 'covariance is a ndarray of shape (3, 3)'),
        ({'id': 7}, 'ID 7'),
    ],
)
def test_a_map_that_no_file_could_hold_is_refused(tmp_path, fields, words):
    """A map that was made in a program: the camera was nowhere, or an error of linear algebra came frames later."""
    marker_map = MarkerMap({2: entry(**fields)})
    for use in (partial(MarkerMapper, MarkerMapperConfig()), partial(save_map, tmp_path / 'map.yaml')):
        with pytest.raises(InputError) as caught:
            use(marker_map)
        assert str(caught.value).startswith('marker 2 of the map: ')
        assert words in str(caught.value)
    assert not (tmp_path / 'map.yaml').exists()


@pytest.mark.parametrize('size', [0.0, -0.3, np.nan, '0.3'])
def test_a_side_that_is_none_is_refused_where_the_file_leaves_it_out(tmp_path, size):
    path = tmp_path / 'map.yaml'
    save_map(path, MarkerMap({2: entry()}))
    assert load_map(path, size).markers[2].size == 0.3
    path.write_text(path.read_text().replace('size: 0.3, ', ''))
    with pytest.raises(InputError, match=f'^marker size for {path}: .* is not a side in metres'):
        load_map(path, size)
    with pytest.raises(InputError, match='is not a side in metres'):
        load_map(path, 0.3, {2: size})
