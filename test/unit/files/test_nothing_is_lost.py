"""No map is lost: signals during shutdown, kills, other programs at the same file, files that cannot be replaced."""

from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from support.shutdowns import grown, whole

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import map_history
from thermal_fiducial.files.map_keeper import MapKeeper
from thermal_fiducial.files.marker_map import load_map, save_map

ROOT = Path(__file__).resolve().parents[3]
AUTOSAVE_S = 30.0


@pytest.fixture
def path(tmp_path):
    folder = tmp_path / 'maps'
    folder.mkdir()
    save_map(folder / 'hall.yaml', grown(1))
    return folder / 'hall.yaml'


def keeper_of(path, robot=''):
    keeper = MapKeeper(path, 0.3, {}, robot=robot)
    keeper.read()
    keeper.take()
    keeper.unsaved = True
    return keeper


def autosaved(keeper, marker_map):
    """Leave a copy as a timer would, and wait for the disk."""
    keeper.unsaved = True
    keeper.autosave(marker_map)
    keeper.finish()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize('way', ['signals', 'kill'])
@pytest.mark.parametrize('count', [6, pytest.param(40, marks=pytest.mark.nightly)])
def test_no_way_to_end_a_mapper_loses_its_map(tmp_path, way, count):
    """Two or three of SIGINT, SIGTERM and SIGHUP 1 to 400 ms apart; SIGKILL at any instant."""
    command = [sys.executable, '-m', 'support.shutdowns', str(tmp_path), str(count), '7', way]
    environment = os.environ | {'PYTHONPATH': f'{ROOT}{os.pathsep}{ROOT / "test"}'}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (0, ''), done.stderr[-2000:]


def test_a_mapper_that_crashes_again_before_its_first_autosave_goes_on_once_more(path):
    autosaved(keeper_of(path), grown(2))
    file = map_history.autosave_file(path)
    for _ in range(3):
        # It flies for nearly a period, and takes some time to start.
        aged = file.stat().st_mtime_ns - round(1.2 * AUTOSAVE_S * 1e9)
        os.utime(path, ns=(aged, aged))
        os.utime(file, ns=(aged, aged))
        recovered, note = MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S)
        assert recovered is not None, note
        assert recovered.revision == 2


def test_an_autosave_is_named_offered_and_taken_up(path, capsys):
    autosaved(keeper_of(path), grown(2))
    # The mapper is killed here, and started again the day after: the map file counts until somebody says otherwise.
    file = map_history.autosave_file(path)
    later = MapKeeper(path, 0.3, {})
    os.utime(file, (file.stat().st_atime, path.stat().st_mtime + 1.0))
    recovered, note = later.recover(0.0)
    assert recovered is None
    assert str(file) in note
    assert 'map undo' in note
    assert main(['map', 'history', str(path)]) == 0
    assert 'autosaved  revision 2' in capsys.readouterr().out
    assert main(['map', 'undo', str(path)]) == 0
    assert whole(path) == 2
    assert not file.exists()
    assert main(['map', 'undo', str(path)]) == 0
    assert whole(path) == 1


def test_a_crashed_mapper_recovers_its_map(path):
    autosaved(keeper_of(path), grown(2))
    restarted = MapKeeper(path, 0.3, {})
    restarted.read()
    restarted.take()
    recovered, note = restarted.recover(AUTOSAVE_S)
    assert recovered.revision == 2
    assert 'goes on with' in note
    assert restarted.save(grown(3)) == path
    assert not map_history.autosave_file(path).exists()


def test_a_map_that_a_load_has_discarded_does_not_come_back(path):
    keeper = keeper_of(path)
    autosaved(keeper, grown(2))
    keeper.read()
    keeper.put_aside(grown(2))
    keeper.take()
    restarted = MapKeeper(path, 0.3, {})
    restarted.read()
    restarted.take()
    assert restarted.recover(AUTOSAVE_S) == (None, '')


def test_a_flown_map_that_is_replaced_unsaved_is_kept_beside_the_file(path):
    keeper = keeper_of(path)
    autosaved(keeper, grown(2))
    for revision in (3, 4):
        keeper.unsaved = True
        aside = keeper.put_aside(grown(revision))
        assert (aside, whole(aside)) == (path.with_name('hall.replaced.yaml'), revision)
        keeper.take()
        assert keeper.put_aside(grown(revision)) is None
    assert whole(path) == 1
    assert main(['map', 'undo', str(aside)]) == 0
    assert whole(aside) == 3


def test_a_map_that_cannot_be_put_aside_stays(path, monkeypatch):
    keeper = MapKeeper(path, 0.3, {}, flown=False)
    keeper.read()
    keeper.take()
    keeper.unsaved = True
    monkeypatch.setattr(map_history, 'write_atomically', lambda *_: (_ for _ in ()).throw(OSError(28, 'No space left')))
    with pytest.raises(InputError, match=r'hall\.replaced\.yaml.*No space left'):
        keeper.put_aside(grown(2))
    assert keeper.unsaved


def test_a_map_that_came_too_late_to_be_taken_replaces_nothing(path):
    """A disk was busy for longer than the service waits; meanwhile another program has changed the file."""
    keeper = keeper_of(path)
    save_map(path, grown(5))
    keeper.read()
    assert keeper.unsaved
    assert keeper.save(grown(2)) != path
    assert whole(path) == 5


def test_an_unused_autosave_is_kept_beside_a_newer_one(path):
    autosaved(keeper_of(path), grown(2))
    autosaved(keeper_of(path), grown(3))
    assert whole(map_history.autosave_file(path)) == 3
    (entry,) = map_history.entries(path)
    assert (entry.action, entry.revision) == (map_history.PUT_ASIDE, 2)


def test_robots_that_map_into_one_file_keep_each_others_autosave(path, capsys):
    """They shared it: the first to end deleted it, and one that started resumed the map of another."""
    first, second = keeper_of(path), keeper_of(path, 'drone2')
    autosaved(first, grown(2))
    autosaved(second, grown(3))
    mine, other = (map_history.autosave_file(path, robot) for robot in ('', 'drone2'))
    third, note = MapKeeper(path, 0.3, {}, robot='drone3').recover(AUTOSAVE_S)
    assert third is None
    assert f'{mine} (revision 2, 60 markers) is of the mapper of another robot' in note
    assert f'{other} (revision 3, 60 markers) is of the mapper of another robot' in note
    assert main(['map', 'history', str(path)]) == 0
    assert f'revision 3, 60 markers in {other}: map undo takes it up' in capsys.readouterr().out
    # The first one lands; the second one crashes before its next autosave, and after it.
    assert first.save(grown(4)) == path
    assert (mine.exists(), whole(other)) == (False, 3)
    again, note = MapKeeper(path, 0.3, {}, robot='drone2').recover(AUTOSAVE_S)
    assert again is None
    assert f'{other} (revision 3, 60 markers) was never saved, but another map has been written since' in note
    assert main(['map', 'history', str(path)]) == 0
    assert f'revision 3, 60 markers in {other}, before the map was written' in capsys.readouterr().out
    autosaved(second, grown(5))
    again, note = MapKeeper(path, 0.3, {}, robot='drone2').recover(AUTOSAVE_S)
    assert again.revision == 5, note


def test_a_clock_that_begins_anew_with_each_flight_loses_no_autosave(path, capsys):
    """Without a battery or a network it does: the map of the last flight was taken for later than what is flown now."""
    autosaved(keeper_of(path), grown(2))
    ahead = map_history.autosave_file(path).stat().st_mtime + 1200.0
    os.utime(path, (ahead, ahead))
    again, note = MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S)
    assert again.revision == 2, note
    # Another map is another matter.
    save_map(path, grown(7))
    os.utime(path, (ahead, ahead))
    assert MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S)[0] is None
    save_map(path, grown(1))
    os.utime(path, (ahead, ahead))
    assert main(['map', 'undo', str(path)]) == 0
    assert (whole(path), path.read_text().partition('\n')[0]) == (2, 'format: thermal_fiducial/marker_map')


@pytest.mark.parametrize('future', ['map', 'autosave', 'both'])
def test_files_of_a_later_release_are_named_and_stay(path, capsys, future):
    """An autosave of another schema was passed over in silence; the history of such a map named none."""
    autosaved(keeper_of(path), grown(2))
    copy = map_history.autosave_file(path)
    for file in {'map': [path], 'autosave': [copy], 'both': [path, copy]}[future]:
        stamps = file.stat().st_atime_ns, file.stat().st_mtime_ns
        file.write_text(file.read_text().replace('version: 1', 'version: 2'))
        os.utime(file, ns=stamps)
    recovered, note = MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S)
    assert (recovered is None) == (future != 'map')
    assert str(copy) in note
    assert main(['map', 'history', str(path)]) == (0 if future == 'autosave' else 2)
    words = 'revision 2, 60 markers in' if future == 'map' else f'{copy}: line 3: version: schema 2 is unknown'
    assert f'autosaved  {words}' in capsys.readouterr().out
    if future != 'map':
        _, before = copy.read_text().split('\n', 1)
        autosaved(keeper_of(path) if future == 'autosave' else MapKeeper(path, 0.3, {}), grown(3))
        (file,) = map_history.history_folder(path).iterdir()
        assert file.read_text().endswith(before)


def test_an_autosave_that_was_edited_is_one_autosave(path):
    """Its history, a folder, was taken for that of another robot."""
    autosaved(keeper_of(path), grown(2))
    copy = map_history.autosave_file(path)
    assert main(['map', 'unfix', str(copy), '0']) == 0
    assert map_history.history_folder(copy).exists()
    assert [entry.path for entry in map_history.autosaves(path)] == [copy]
    _, note = MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S)
    assert 'another robot' not in note


def test_a_map_that_was_saved_beside_its_file_leaves_no_autosave(path):
    """The next mapper resumed it, with the words that the last one had not ended in order, over what was edited."""
    keeper = keeper_of(path)
    assert main(['map', 'move', str(path), '3', '--position', '1', '2', '3']) == 0
    autosaved(keeper, grown(2))
    assert keeper.save(grown(2)) == path.with_name('hall.new.yaml')
    assert MapKeeper(path, 0.3, {}).recover(AUTOSAVE_S) == (None, '')


def test_an_unchanged_map_is_not_autosaved(path):
    keeper = keeper_of(path)
    keeper.unsaved = False
    keeper.autosave(grown(2))
    keeper.finish()
    assert not map_history.autosave_file(path).exists()


def test_a_file_that_another_program_has_changed_is_not_overwritten(path):
    keeper = keeper_of(path)
    assert main(['map', 'move', str(path), '3', '--position', '1', '2', '3']) == 0
    edited = path.read_bytes()
    beside = keeper.save(grown(2))
    assert beside == path.with_name('hall.new.yaml')
    assert (path.read_bytes(), whole(beside)) == (edited, 2)
    keeper.read()
    keeper.take()
    assert keeper.save(grown(5)) == path


def test_an_edit_right_behind_a_save_is_not_overwritten_by_the_next(path, monkeypatch):
    """Somebody has waited for the lock of the mapper that saves."""
    keeper, save = keeper_of(path), map_history.save_with_history

    def saved_and_edited(*arguments):
        found = save(*arguments)
        assert main(['map', 'move', str(path), '3', '--position', '1', '2', '3']) == 0
        return found

    with monkeypatch.context() as busy:
        busy.setattr(map_history, 'save_with_history', saved_and_edited)
        assert keeper.save(grown(2)) == path
    edited = path.read_bytes()
    assert keeper.save(grown(5)) == path.with_name('hall.new.yaml')
    assert path.read_bytes() == edited


def test_a_file_that_cannot_be_replaced_is_saved_beside(path, monkeypatch):
    keeper = keeper_of(path)
    path.unlink()
    path.mkdir()
    (path / 'x').touch()
    assert whole(keeper.save(grown(2))) == 2


def test_two_writers_lose_no_edit(path):
    """Eight edits each, in processes of their own."""
    program = (
        'import sys\nfrom thermal_fiducial.cli.main import main\nfrom thermal_fiducial.files import atomic\n'
        # On a busy machine the other one may have the folder for long: who waits loses nothing.
        'atomic.PATIENCE_S = 120.0\n'
        'for i in range(int(sys.argv[2]), 16, 2):\n'
        "    assert main(['map', 'move', sys.argv[1], str(i), '--position', str(i), '7', '7']) == 0\n"
    )

    def write(first):
        arguments = [sys.executable, '-c', program, str(path), str(first)]
        return subprocess.run(arguments, capture_output=True, text=True, timeout=300, check=False)

    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(write, (0, 1)))
    assert [each.returncode for each in done] == [0, 0], done[0].stderr + done[1].stderr
    found = load_map(path)
    assert found.revision == 17
    for i in range(16):
        np.testing.assert_allclose(found.markers[i].T_map_marker[:3, 3], [i, 7.0, 7.0])


def test_a_link_leads_to_the_history_and_the_autosave_of_its_file(path, tmp_path):
    """They lay beside the link: pointed at another hall, it offered the maps of the one before for undo."""
    link = tmp_path / 'current.yaml'
    link.symlink_to(path)
    map_history.save_with_history(link, grown(2), 'fly')
    autosaved(keeper_of(link), grown(3))
    assert [entry.action for entry in map_history.entries(path)] == ['fly']
    assert map_history.autosaved(path).revision == 3
    other = path.with_name('other.yaml')
    save_map(other, grown(5))
    link.unlink()
    link.symlink_to(other)
    assert map_history.entries(link) == []
    assert map_history.autosaved(link) is None


def test_undo_survives_broken_entries_and_strange_names(path):
    save = map_history.save_with_history
    for revision in (2, 3, 4):
        save(path, grown(revision), f'make {revision}')
    folder = map_history.history_folder(path)
    (folder / '000001.yaml').write_bytes(b'\xff\xfe')
    (folder / '000003.yaml').write_text('not: [a map')
    (folder / '9a.yaml').write_text('what is this')
    (path.parent / '.hall.yaml.abc.tmp').write_text('left by a writer that was killed')
    (folder / '.000004.yaml.abc.tmp').write_text('left by another')
    assert [bool(entry.problem) for entry in map_history.entries(path)] == [True, False, True]
    assert map_history.undo(path).revision == 2
    assert whole(path) == 2
    with pytest.raises(InputError, match='no earlier version'):
        map_history.undo(path)
    save(path, grown(5), 'make 5')
    assert sorted(file.name for file in path.parent.iterdir()) == ['hall.yaml', 'hall.yaml.history']
    assert not list(folder.glob('.*'))


def test_a_map_that_has_not_changed_makes_no_history(path):
    for _ in range(3):
        map_history.save_with_history(path, grown(1), 'save')
    assert map_history.entries(path) == []


def test_an_edit_that_changes_nothing_makes_no_history(path, capsys):
    assert main(['map', 'fix', str(path), '0']) == 0
    before, history = path.read_bytes(), map_history.entries(path)
    capsys.readouterr()
    assert main(['map', 'fix', str(path), '0']) == 0
    assert 'nothing to change' in capsys.readouterr().out
    assert path.read_bytes() == before
    assert map_history.entries(path) == history


@pytest.mark.parametrize(
    'arguments',
    [
        ['move', '0', '--position', 'nan', '0', '0'],
        ['move', '0', '--position', 'inf', '0', '0'],
        ['move', '0', '--position', '1e300', '0', '0'],
        ['move', '0', '--position', '0', '0', '0', '--sigma', '-1'],
        ['move', '0', '--position', '0', '0', '0', '--sigma-deg', 'nan'],
        ['move', '0', '--position', '0', '0', '0', '--orientation', 'nan', '0', '0', '1'],
        ['rename', '2', '-3'],
        ['rename', '2', '50'],
        ['rename', '2', str(2**70)],
    ],
)
def test_an_edit_that_could_not_be_read_back_is_refused(path, capsys, arguments):
    before = path.read_bytes()
    try:
        status = main(['map', arguments[0], str(path), *arguments[1:]])
    except SystemExit as error:  # argparse's own refusal
        status = error.code
    assert status == 2
    assert path.read_bytes() == before
    assert 'Traceback' not in capsys.readouterr().err


def test_the_check_names_markers_that_the_dictionary_has_not(path, capsys):
    save_map(path, MarkerMap({77: MapMarker(77, 0.3, True, np.eye(4))}))
    assert main(['map', 'check', str(path)]) == 1
    assert 'marker 77: not in DICT_4X4_50' in capsys.readouterr().out
