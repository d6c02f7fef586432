"""The map command: every action on small files."""

from dataclasses import replace
from itertools import pairwise
import re

from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
import pytest
from support import small_bag
from support.commands import status
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.cli import map_sources
from thermal_fiducial.cli.main import main
from thermal_fiducial.cli.map_plot import draw_map
from thermal_fiducial.cli.run_parameters import camera_of_run
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import apply, difference, inverse, lever_arm, retract, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import CORNER_FIELDS
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.dictionary import load_dictionary, save_dictionary
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.map_tools.anchoring import anchor
from thermal_fiducial.map_tools.map_building import build_map
from thermal_fiducial.map_tools.map_doubts import doubts
from thermal_fiducial.map_tools.map_editing import merge, transformed

#: Left-handed axes of a survey, rows in those of the map.
NORTH_EAST_UP, EAST_NORTH_DOWN = np.eye(3)[[1, 0, 2]], np.diag([1.0, 1.0, -1.0])


@pytest.fixture
def poses():
    return wall(np.random.default_rng(3))


@pytest.fixture
def path(tmp_path, poses):
    path = tmp_path / 'map.yaml'
    covariance = 1e-6 * np.eye(6)
    save_map(
        path,
        MarkerMap(
            {i: MapMarker(i, SIZE, i == 0, T, 0 * covariance if i == 0 else covariance) for i, T in poses.items()}
        ),
    )
    return path


def run(*arguments):
    return main(['map', *(str(argument) for argument in arguments)])


def write_survey(path, places):
    """A file of the positions (3,) [m] by ID."""
    path.write_text(''.join(f'{key},{x},{y},{z}\n' for key, (x, y, z) in places.items()))


def test_show_lists_and_draws(path, capsys):
    assert run('show', path, '--plot', path.with_name('plot.png')) == 0
    shown = capsys.readouterr().out
    assert 'fixed' in shown
    assert path.with_name('plot.png').read_bytes().startswith(b'\x89PNG')


def test_sides_of_markers_stand_before_the_action_or_behind_it(tmp_path, capsys):
    text = 'position: [0, 0, 1], orientation: [0.5, 0.5, 0.5, 0.5]'
    markers = ''.join(f'- {{id: {key}, fixed: true, {text}}}\n' for key in (2, 3, 4))
    plain = tmp_path / 'plain.yaml'
    plain.write_text(f'format: thermal_fiducial/marker_map\nversion: 1\ndictionary: DICT_4X4_50\nmarkers:\n{markers}')
    option = '--marker-size-override'
    assert run('--marker-size', 0.3, option, '2:0.21', option, '3:0.1', 'show', plain, option, '3:0.43') == 0
    shown = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert [row for row in shown if len(row) == 2 and row[0] in '234'] == [['2', '0.21'], ['3', '0.43'], ['4', '0.3']]
    with pytest.raises(SystemExit, match='2'):
        run('show', plain, option, '3')
    assert f"argument {option}: '3' is not ID:SIZE" in capsys.readouterr().err


def test_check_distinguishes_sound_from_doubtful(path, capsys):
    assert run('check', path) == 0
    assert run('unfix', path, 0) == 0
    assert run('check', path) == 1
    doubts = capsys.readouterr().out
    assert 'no marker is fixed' in doubts
    assert 'taken for exact' in doubts
    assert doubts.endswith(': 2 doubts\n')


def test_positions_in_millimetres_are_doubtful(path, capsys):
    T = np.eye(4)
    T[0, 3] = 2500.0
    save_map(path, MarkerMap({7: MapMarker(7, SIZE, True, T)}))
    assert run('check', path) == 1
    assert 'marker 7: 2500 m from the origin: positions are in metres' in capsys.readouterr().out


@pytest.mark.parametrize('name', ['gone.yaml', '/elsewhere/own.yaml'])
def test_check_names_a_dictionary_that_cannot_be_opened(name, path, capsys):
    """It said "sound" although it had not looked at the IDs. Edits need no dictionary."""
    path.write_text(path.read_text().replace('DICT_4X4_50', name))
    assert run('check', path) == 1
    doubt, verdict = capsys.readouterr().out.splitlines()
    assert doubt.startswith('whether its dictionary has these markers is unknown: ')
    assert name in doubt
    assert verdict == f'{path}: 1 doubt'
    assert run('rename', path, 4, 4000) == 0


def test_negative_numbers_as_programs_print_them(path):
    """Python prints -0.00003 as -3e-05, which argparse took for an option."""
    assert run('move', path, 3, '--position', '-1.', '-.5', '-3e-05', '--orientation', '-3E-06', 0, 0, 1) == 0
    assert load_map(path).markers[3].T_map_marker[:3, 3].tolist() == [-1.0, -0.5, -3e-5]


def test_edits_make_versions_that_can_be_undone(path, poses, capsys):
    first = path.read_bytes()
    assert run('fix', path, 1, 2) == 0
    assert run('move', path, 3, '--position', 1, 2, 3) == 0
    assert run('rename', path, 4, 40) == 0
    assert run('delete', path, 5, 6) == 0
    edited = load_map(path)
    assert edited.revision == 5
    assert sorted(edited.markers) == [0, 1, 2, 3, 7, 40]
    assert edited.markers[1].fixed
    np.testing.assert_allclose(edited.markers[3].T_map_marker[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(edited.markers[3].T_map_marker[:3, :3], poses[3][:3, :3], atol=1e-8)
    assert edited.markers[40].id == 40
    assert run('history', path) == 0
    printed = capsys.readouterr().out
    assert [line.split('before: ')[1] for line in printed.splitlines() if 'before' in line] == [
        'fix 1 2', 'move 3', 'rename 4 to 40', 'delete 5 6',
    ]  # fmt: skip
    for _ in range(4):
        assert run('undo', path) == 0
    assert path.read_bytes() == first
    assert run('undo', path) == 2


def test_maps_of_markers_without_sides_are_upgraded_and_have_a_history(tmp_path, capsys):
    """Their sides are those of the nodes' parameters, which neither action needs."""
    path = tmp_path / 'map.yaml'
    entry = '{id: 2, fixed: true, position: [1, 2, 3], orientation: [0, 0, 0, 1]}'
    path.write_text(f'format: thermal_fiducial/marker_map\nversion: 12\nmarkers:\n  - {entry}\n')
    assert run('upgrade', path) == 0
    assert run('history', path) == 0
    printed = capsys.readouterr().out
    assert f'{path}: upgraded; revision 12' in printed
    assert 'now  revision 12, 1 marker' in printed
    # "No earlier version is kept", where the history lists one, is no answer.
    assert run('undo', path) == 2
    error = capsys.readouterr().err
    assert 'no earlier version is kept that can be read' in error
    assert 'schema 12 is unknown' in error


@pytest.mark.parametrize(
    'arguments',
    [
        ('fix', 'MAP', 99),
        ('rename', 'MAP', 1, 2),
        ('rename', 'MAP', 99, 2),
        ('delete', 'MAP', 99),
        ('move', 'MAP', 99, '--position', 0, 0, 0),
        ('show', 'MAP.missing'),
        ('align', 'MAP', '--cloud', 'missing.ply'),
        ('align', 'MAP', '--cloud', 'CLOUD', '--initial', 0, 0, 0, 0, 0, 0, 0),
        ('merge', 'MAP', 'missing.yaml'),
        ('anchor', 'MAP', 'missing.csv'),
    ],
)
def test_impossible_edits_are_refused_in_one_line(path, capsys, arguments):
    before = path.read_bytes()
    cloud = path.with_name('room.ply')
    write_ply(cloud, np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 3)))
    assert run(*(str(a).replace('MAP', str(path)).replace('CLOUD', str(cloud)) for a in arguments)) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert path.read_bytes() == before


def test_merge_brings_two_maps_into_one_frame(path, poses, capsys):
    """The second map is of another frame, lacks some markers, has others, and one marker was moved in between."""
    T = transform(so3_exp([0.1, -0.3, 1.0]), [5.0, -2.0, 1.0])
    moved = poses[2] @ transform(np.eye(3), [0.2, 0.0, 0.0])
    covariance = 1e-6 * np.eye(6)
    other = {i: MapMarker(i, SIZE, False, poses[i], covariance) for i in (0, 1, 3, 4)}
    other |= {2: MapMarker(2, SIZE, False, moved, covariance), 30: MapMarker(30, SIZE, False, poses[6], covariance)}
    second = path.with_name('second.yaml')
    save_map(second, transformed(MarkerMap(other), T))
    assert run('merge', path, second) == 0
    assert 'marker 2: ' in capsys.readouterr().out
    merged = load_map(path)
    assert sorted(merged.markers) == [*range(8), 30]
    # Exact but for the nine decimals of the files.
    assert np.max(np.abs(difference(merged.markers[30].T_map_marker, poses[6]))) < 1e-7
    assert np.max(np.abs(difference(merged.markers[2].T_map_marker, poses[2]))) < 1e-7


@pytest.mark.parametrize('name', ['map.yaml', 'cloud.ply', 'here/map.yaml'])
def test_align_does_not_replace_its_inputs(path, capsys, name):
    """The transform took the place of the map, which has no history of that."""
    cloud = path.with_name('cloud.ply')
    write_ply(cloud, np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 3)))
    (path.parent / 'here').symlink_to('.')
    before = path.read_bytes(), cloud.read_bytes()
    assert run('align', path, '--cloud', cloud, '--out', path.parent / name) == 2
    assert 'the transform would replace that file' in capsys.readouterr().err
    assert (path.read_bytes(), cloud.read_bytes()) == before


def test_a_side_in_centimetres_is_refused(path, capsys):
    """It made a map a hundred times too large, which a mapper would take."""
    with pytest.raises(SystemExit, match='2'):
        run('--marker-size', 30, 'show', path)
    assert "'30' is not a number from 0.005 to 10 m" in capsys.readouterr().err


def test_anchor_names_surveyed_markers_that_the_map_lacks(path, poses, capsys):
    """A wrong ID in the survey was passed over in silence."""
    survey = path.parent / 'survey.csv'
    places = {key: poses[key][:3, 3] for key in (0, 3, 5)} | {99: np.zeros(3)}
    write_survey(survey, places)
    assert run('anchor', path, survey) == 0
    assert 'marker 99: surveyed, but not in the map' in capsys.readouterr().out


def test_anchor_moves_the_map_onto_a_survey(path, poses):
    T = transform(so3_exp([0.0, 0.0, 0.7]), [100.0, 50.0, 2.0])
    survey = path.with_name('survey.csv')
    lines = [f'{i},{",".join(str(v) for v in apply(T, poses[i][None, :3, 3])[0])}' for i in (0, 3, 5)]
    survey.write_text('id,x,y,z\n' + '\n'.join(lines) + '\n')
    assert run('anchor', path, survey, '--fix') == 0
    anchored = load_map(path)
    for i, pose in poses.items():
        assert np.max(np.abs(difference(anchored.markers[i].T_map_marker, T @ pose))) < 1e-7
        assert anchored.markers[i].fixed == (i in (0, 3, 5))
    survey.write_text('0,1,2,3\n1,2,3\n')
    assert run('anchor', path, survey) == 2
    # Turned about a diagonal they would fit as well.
    survey.write_text('ID,Z,X,Y\n' + '\n'.join(lines) + '\n')
    assert run('anchor', path, survey) == 2


def test_anchor_says_what_the_alignment_leaves_open(path, poses, capsys):
    """Centres surveyed to 3 mm on 2 m move a marker that is 20 m away by centimetres, and nothing said so."""
    surveyed = {key: poses[key][:3, 3] for key in (0, 2, 3, 5)}
    far = transform(np.eye(3), [20.0, 3.0, 1.0])
    marker_map = MarkerMap({key: MapMarker(key, SIZE, False, pose) for key, pose in poses.items()})
    marker_map.markers[40] = MapMarker(40, SIZE, False, far)
    rng = np.random.default_rng(1)
    off, claimed = [], []
    for _ in range(200):
        survey = {key: place + 0.003 * rng.standard_normal(3) for key, place in surveyed.items()}
        anchored = anchor(marker_map, survey)
        key, std = anchored.least_known
        assert key == 40
        off.append(np.linalg.norm(anchored.map.markers[40].T_map_marker[:3, 3] - far[:3, 3]))
        claimed.append(std)
    # The mean of 200 squares of three errors each is good to 6 %, that of the claims, by six residuals, to 4 %.
    assert 0.8 < np.mean(np.square(off)) / np.mean(np.square(claimed)) < 1.25
    save_map(path, marker_map)
    file = path.with_name('survey.csv')
    write_survey(file, survey)
    assert run('anchor', path, file) == 0
    assert f'marker 40: {1e3 * claimed[-1]:.1f} mm off by the alignment (1 sigma)' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('scale', 'ids'),
    [
        # In millimetres; markers 0 and 5 exchanged.
        (1000.0, (0, 3, 5, 6)),
        (1.0, (5, 3, 0, 6)),
    ],
)
def test_a_survey_that_contradicts_the_map_is_refused(path, poses, capsys, scale, ids):
    """The map was written, kilometres away, and with --fix its markers declared surveyed there."""
    survey, before = path.with_name('survey.csv'), path.read_bytes()
    places = [scale * poses[key][:3, 3] for key in (0, 3, 5, 6)]
    write_survey(survey, dict(zip(ids, places, strict=True)))
    assert run('anchor', path, survey, '--fix') == 2
    assert 'survey.csv: the survey contradicts the map: marker ' in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize('axes', [NORTH_EAST_UP, EAST_NORTH_DOWN])
def test_a_left_handed_survey_is_refused(path, poses, capsys, axes):
    """Its numbers were said to be no metres, or its IDs wrong."""
    survey, before = path.with_name('survey.csv'), path.read_bytes()
    write_survey(survey, {key: axes @ pose[:3, 3] for key, pose in poses.items()})
    assert run('anchor', path, survey) == 2
    assert 'survey.csv: the survey is a mirror image of the map' in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ('axes', 'sides', 'turned_deg'),
    [
        (np.eye(3), 'faces -x, its top points to +z', None),
        (NORTH_EAST_UP, 'faces +y, its top points to +z', None),
        (EAST_NORTH_DOWN, 'faces +x, its top points to -z', 180),
    ],
)
def test_a_survey_in_a_plane_shows_its_axes_by_the_sides_of_the_markers(tmp_path, capsys, axes, sides, turned_deg):
    """Left-handed axes fit at 0.0 mm: the map faced the other side, or stood on its head, without a word."""
    path, survey = tmp_path / 'map.yaml', tmp_path / 'survey.csv'
    poses = wall(np.random.default_rng(3), tilt=0.0)
    for pose in poses.values():
        pose[0, 3] = 3.0
    save_map(path, MarkerMap({key: MapMarker(key, SIZE, True, pose) for key, pose in poses.items()}))
    write_survey(survey, {key: axes @ pose[:3, 3] for key, pose in poses.items()})
    assert run('anchor', path, survey) == 0
    printed = capsys.readouterr()
    assert f'marker 3: 0.0 mm from its surveyed place; {sides}' in printed.out
    assert 'left-handed axes fit as well' in printed.err
    assert (f'z of the map is turned by {turned_deg} deg' in printed.err) == (turned_deg is not None)


def test_a_survey_with_z_downwards_is_warned_of(path, poses, capsys):
    """North, east, down is right-handed and fits: the map stood on its head."""
    survey = path.with_name('survey.csv')
    write_survey(survey, {key: np.diag([1.0, -1.0, -1.0]) @ pose[:3, 3] for key, pose in poses.items()})
    assert run('anchor', path, survey) == 0
    error = capsys.readouterr().err
    assert 'z of the map is turned by 180 deg' in error
    assert 'left-handed' not in error


@pytest.mark.parametrize(
    ('survey', 'words'),
    [
        ('1,0,0,1\n2,1,0,1\n3,2,0,1\n', 'they leave a rotation open'),
        ('1,0,0,1\n2,0,0,1\n3,0,0,1\n', 'they leave a rotation open'),
        ('id,x,y,z\n0,0,0,1\n900,1,0,1\n901,0,1,1\n', 'survey.csv: 1 surveyed marker in the map: three are needed'),
        ('0,0,0,1\n3,1,0,1\n5,0,1,1\n0,0,5,1\n', 'survey.csv: line 4: marker 0 for the second time'),
    ],
)
def test_a_survey_that_does_not_settle_the_frame_is_refused(path, survey, words, capsys):
    (path.parent / 'survey.csv').write_text(survey)
    before = path.read_bytes()
    assert run('anchor', path, path.parent / 'survey.csv') == 2
    assert words in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize('common', [1, 2, 3])
def test_a_merged_marker_claims_what_the_common_ones_leave_open(common):
    """Ten metres beside them: what they are turned by moves it most."""
    poses, stds = wall(np.random.default_rng(0)), np.repeat((0.003, 0.01), 3)
    places = {key: poses[key] for key in range(common)} | {9: retract(poses[0], [0.0, 10.0, 0.0, 0.0, 0.0, 0.0])}
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        maps = [
            MarkerMap(
                {
                    key: MapMarker(key, SIZE, False, retract(places[key], stds * rng.normal(size=6)), np.diag(stds**2))
                    for key in ids
                }
            )
            for ids in (range(common), places)
        ]
        added = merge(*maps)[0].markers[9]
        d = difference(added.T_map_marker, places[9])
        squares.append(d @ np.linalg.solve(added.covariance, d))
    # Claims bound errors that may be correlated, these are not; without the way to the marker it is 15.
    assert 0.4 < np.mean(squares) / 6.0 < 1.5


@pytest.mark.parametrize('common', [2, 3])
def test_a_merged_marker_is_known_no_better_than_what_the_common_ones_share(common):
    """Twenty metres from the anchor of their map they are turned about it together, which shows in no misfit."""
    poses, own, turn = wall(np.random.default_rng(0)), np.repeat((0.001, 0.0005), 3), 0.001
    away = np.array([0.0, 20.0, 0.0, 0.0, 0.0, 0.0])
    places = {key: retract(poses[key], away) for key in [*range(common), common]}
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        shared, maps = turn * rng.normal(size=3), []
        for of_all, ids in ((1.0, range(common)), (0.0, places)):
            markers = {}
            for key in ids:
                arm = of_all * lever_arm(places[key][:3, 3])[:, 3:]
                off = retract(places[key], arm @ shared + own * rng.normal(size=6))
                markers[key] = MapMarker(key, SIZE, False, off, turn**2 * arm @ arm.T + np.diag(own**2))
            maps.append(MarkerMap(markers))
        added = merge(*maps)[0].markers[common]
        d = difference(added.T_map_marker, places[common])
        squares.append(d @ np.linalg.solve(added.covariance, d))
    # By their misfit alone 50 to 70.
    assert 0.2 < np.mean(squares) / 6.0 < 1.5


@pytest.mark.parametrize('common', [1, 3])
def test_a_common_marker_is_known_no_better_than_the_frame_it_is_merged_into(common):
    """Surveyed to 20 mm in the map that stays, and known exactly in the one that is added."""
    poses, stds = wall(np.random.default_rng(0)), np.repeat((0.02, 0.03), 3)
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        off = {key: retract(poses[key], stds * rng.normal(size=6)) for key in range(common)}
        coarse = MarkerMap({key: MapMarker(key, SIZE, False, off[key], np.diag(stds**2)) for key in off})
        precise = MarkerMap({key: MapMarker(key, SIZE, True, poses[key]) for key in off})
        for key, marker in merge(coarse, precise)[0].markers.items():
            d = difference(marker.T_map_marker, poses[key])
            squares.append(d @ np.linalg.solve(marker.covariance, d))
    assert 0.4 < np.mean(squares) / 6.0 < 1.5


def test_markers_in_quarantine_align_no_maps():
    poses = wall(np.random.default_rng(0))
    maps = [MarkerMap({key: MapMarker(key, SIZE, key == 0, poses[key]) for key in ids}) for ids in ((0, 1), (0, 1, 3))]
    moved = maps[1].markers[1]
    off = retract(moved.T_map_marker, [0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    maps[1].markers[1] = replace(moved, T_map_marker=off, trusted=False)
    merged, _ = merge(*maps)
    assert np.abs(difference(merged.markers[3].T_map_marker, poses[3])).max() < 1e-9


def test_refine_adjusts_a_map_to_the_detections_of_a_run(path, poses):
    run_folder = path.with_name('run')
    run_folder.mkdir()
    (run_folder / 'detections.csv').write_text(detections(poses))
    save_camera(path.with_name('camera.yaml'), CAMERA)
    start = MarkerMap({0: MapMarker(0, SIZE, True, poses[0])})
    save_map(path, start)
    assert run('--marker-size', SIZE, 'refine', path, run_folder, '--calibration', path.with_name('camera.yaml')) == 0
    refined = load_map(path)
    assert sorted(refined.markers) == sorted(poses)
    for i, pose in poses.items():
        # 30 frames of corners of 0.02 px: tenths of a millimetre; ten times that would be a fault.
        assert np.linalg.norm(difference(refined.markers[i].T_map_marker, pose)[:3]) < 2e-3
    assert run('refine', path, path, '--calibration', path.with_name('camera.yaml')) == 2


def detections(poses, side=SIZE):
    """A ``detections.csv`` of a flight past the wall."""
    rng = np.random.default_rng(4)
    rows = [(stamp(k), row) for k in range(0, 300, 10) for row in see(flight(k / 30), poses, 0.02, rng, side)]
    lines = [f'{t},{row["id"]},{",".join(str(row[n]) for n in CORNER_FIELDS)},{row["sigma_px"]}' for t, row in rows]
    return f'stamp_ns,id,{",".join(CORNER_FIELDS)},sigma_px\n' + '\n'.join(lines)


@pytest.mark.parametrize(('unit', 'status'), [(1.0, 0), (1.0 / 0.3048, 2)])
def test_refine_names_the_factor_of_a_map_in_another_unit(path, poses, photographed, capsys, unit, status):
    """A list of quarantined markers was all that it said, and a script went on."""
    in_unit = {key: transform(T[:3, :3], unit * T[:3, 3]) for key, T in poses.items()}
    save_map(path, MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in in_unit.items()}))
    assert run('refine', path, *photographed) == status
    assert ('distances in the map are 3.28 times those seen' in capsys.readouterr().err) == (status == 2)


def test_refine_of_a_map_by_hand_answers_for_the_map_that_it_writes(path, poses, photographed):
    """Most markers were not where the map to start from had them, which is what the refinement cures."""
    rng, stds = np.random.default_rng(3), np.repeat((0.15, 0.05), 3)
    off = {key: retract(T, stds * rng.normal(size=6)) for key, T in poses.items() if key}
    markers = {0: MapMarker(0, SIZE, True, poses[0])} | {key: MapMarker(key, SIZE, False, T) for key, T in off.items()}
    save_map(path, MarkerMap(markers))
    assert run('refine', path, *photographed) == 0
    # As from one marker alone.
    refined = load_map(path).markers
    assert max(np.linalg.norm(difference(refined[key].T_map_marker, T)[:3]) for key, T in poses.items()) < 2e-3


def test_refine_counts_the_frames_that_gave_nothing_by_reason(path, poses, photographed, capsys):
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    lines = photographed[0].read_text().splitlines()
    _, _, corners = lines[1].split(',', 2)
    photographed[0].write_text('\n'.join([*lines, *(f'{stamp(k)},40,{corners}' for k in (400, 500))]))
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 0
    assert '30 of 32 frames used\n2 not used: no known marker in view\n' in capsys.readouterr().out


def test_refine_with_a_run_that_shows_nothing_of_the_map_leaves_it_and_fails(path, poses, photographed, capsys):
    """A run of another hall, say: a script must not go on as if the map had been refined."""
    save_map(path, MarkerMap({40: MapMarker(40, SIZE, True, poses[0]), 41: MapMarker(41, SIZE, False, poses[1])}))
    before = path.read_text()
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 2
    captured = capsys.readouterr()
    assert '30 not used: no known marker in view' in captured.out
    assert 'no frame of it gives a pose in the map' in captured.err
    assert path.read_text() == before


@pytest.mark.parametrize(
    ('column', 'value'),
    [
        *((0, 'nan'), (1, '0.5'), (1, '1e30'), (1, '-3'), (4, 'nan'), (5, 'x')),
        *((10, '0'), (10, '-1'), (10, '1e12'), (10, 'inf')),
    ],
)
def test_refine_refuses_ids_and_errors_that_no_marker_has(path, poses, photographed, capsys, column, value):
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    head, first, *others = photographed[0].read_text().splitlines()
    cells = first.split(',')
    cells[column] = value
    photographed[0].write_text('\n'.join([head, ','.join(cells), *others]))
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 2
    assert 'detections.csv: line 2: not a' in capsys.readouterr().err


def test_refine_counts_no_views_of_frames_without_a_pose(path, poses, photographed):
    """In two more frames the corners run the other way round, as no camera sees them."""
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    lines = photographed[0].read_text().splitlines()
    u0, v0, u1, v1, u2, v2, u3, v3, sigma = next(line for line in lines if line.split(',')[1] == '0').split(',')[2:]
    mirrored = f'0,{u0},{v0},{u3},{v3},{u2},{v2},{u1},{v1},{sigma}'
    counts = []
    for more in ([], [f'{stamp(k)},{mirrored}' for k in (400, 500)]):
        photographed[0].write_text('\n'.join([*lines, *more]))
        assert run('--marker-size', SIZE, 'refine', path, *photographed, '--out', path.with_name('refined.yaml')) == 0
        counts.append(load_map(path.with_name('refined.yaml')).markers[0].observations)
    assert counts[0] == counts[1] > 0


def test_refine_takes_detections_in_any_order(path, poses, photographed, capsys):
    """Sorted by marker, as a spreadsheet leaves them."""
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    head, *lines = photographed[0].read_text().splitlines()
    photographed[0].write_text('\n'.join([head, *sorted(lines, key=lambda line: int(line.split(',')[1]))]))
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 0
    assert '30 of 30 frames used' in capsys.readouterr().out
    assert sorted(load_map(path).markers) == sorted(poses)


@pytest.fixture
def photographed(path, poses):
    """Detections of a flight past the wall, and the calibration of its camera."""
    file = path.with_name('detections.csv')
    file.write_text(detections(poses))
    save_camera(path.with_name('camera.yaml'), CAMERA)
    return [file, '--calibration', path.with_name('camera.yaml')]


@pytest.mark.parametrize('action', ['refine', 'merge'])
def test_a_map_that_is_written_elsewhere_has_its_dictionary_file_beside_it(path, poses, photographed, capsys, action):
    """The file stayed behind, and with it whether the markers are in the dictionary was unknown."""
    own, out = path.with_name('own.yaml'), path.parent / 'maps' / 'hall.yaml'
    out.parent.mkdir()
    save_dictionary(own, 'own', load_dictionary('DICT_4X4_50'))
    save_map(path, replace(load_map(path), dictionary=own.name))
    other = path.with_name('other.yaml')
    save_map(other, load_map(path))
    sources = photographed if action == 'refine' else [other]
    assert run('--marker-size', SIZE, action, path, *sources, '--out', out) == 0
    capsys.readouterr()
    assert run('check', out) == 0
    assert capsys.readouterr().out == f'{out}: sound\n'
    (out.parent / own.name).write_text('other: things')
    assert run('--marker-size', SIZE, action, path, *sources, '--out', out) == 2
    assert f'{out.parent / own.name}: not the dictionary {own}, which a map' in capsys.readouterr().err
    assert (out.parent / own.name).read_text() == 'other: things'


@pytest.mark.parametrize('dictionary', ['own.yaml', '../own.yaml'])
def test_a_map_whose_dictionary_file_is_on_the_robot_is_refined_without_it(path, photographed, dictionary):
    out = path.parent / 'maps' / 'hall.yaml'
    out.parent.mkdir()
    save_map(path, replace(load_map(path), dictionary=dictionary))
    assert run('--marker-size', SIZE, 'refine', path, *photographed, '--out', out) == 0
    assert load_map(out).dictionary == dictionary
    assert not (out.parent / 'own.yaml').exists()


def test_refine_takes_the_calibration_of_the_run(path, poses, photographed, capsys):
    folder = path.with_name('run')
    folder.mkdir()
    photographed[0].rename(folder / 'detections.csv')
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    assert run('--marker-size', SIZE, 'refine', path, folder) == 2
    assert 'is found: give --calibration' in capsys.readouterr().err
    # From its bag.
    recording = small_bag.recording(seconds=0.1)
    recording.write(folder / 'bag')
    (folder / 'summary.json').write_text('{"bag": "bag"}')
    assert camera_of_run(folder).matches(small_bag.CAMERA)
    # What the nodes were given goes before it.
    parameters = f'/tau2_camera: {{ros__parameters: {{calibration_file: {path.with_name("camera.yaml")}}}}}'
    (folder / 'parameters.yaml').write_text(parameters)
    assert run('--marker-size', SIZE, 'refine', path, folder) == 0
    assert sorted(load_map(path).markers) == sorted(poses)


@pytest.mark.parametrize('parameters', ['/tau2_camera: 3', '/tau2_camera: {ros__parameters: [1]}', '[]'])
def test_a_damaged_file_of_a_runs_parameters_is_not_one_without_the_parameter(path, photographed, capsys, parameters):
    """It said that the calibration was missing; with one given, the sides of the run counted as unknown."""
    folder = path.with_name('run')
    folder.mkdir()
    file, *calibration = photographed
    file.rename(folder / 'detections.csv')
    (folder / 'parameters.yaml').write_text(parameters)
    for given in ([], calibration):
        assert run('--marker-size', SIZE, 'refine', path, folder, *given) == 2
        assert f'{folder / "parameters.yaml"}: not of the form' in capsys.readouterr().err
    (folder / 'parameters.yaml').write_text('/pose_ekf: {ros__parameters: {gate: 20.0}}')
    assert run('--marker-size', SIZE, 'refine', path, folder, *calibration) == 0


def test_a_run_that_is_not_there_and_a_folder_for_a_map_are_named(path, tmp_path, capsys):
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, np.eye(4))}))
    assert run('refine', path, tmp_path / 'run') == 2
    assert f'{tmp_path / "run"}: no such run' in capsys.readouterr().err
    # A bag, for example: it said that a calibration was missing.
    (tmp_path / 'bag').mkdir()
    assert run('refine', path, tmp_path / 'bag') == 2
    assert f'{tmp_path / "bag" / "detections.csv"}: cannot read it' in capsys.readouterr().err
    assert run('show', tmp_path) == 2
    assert f'{tmp_path}: is a folder, not a file' in capsys.readouterr().err


@pytest.mark.parametrize('of_run', ['DICT_4X4_50', 'DICT_5X5_100'])
def test_refine_warns_of_detections_in_another_dictionary(path, poses, photographed, capsys, of_run):
    folder = path.with_name('run')
    folder.mkdir()
    file, *calibration = photographed
    file.rename(folder / 'detections.csv')
    (folder / 'parameters.yaml').write_text(f'/aruco_detector: {{ros__parameters: {{dictionary: {of_run}}}}}')
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}, dictionary='DICT_4X4_50'))
    assert run('--marker-size', SIZE, 'refine', path, folder, *calibration) == 0
    warned = 'the map has markers of DICT_4X4_50, but dictionary is DICT_5X5_100' in capsys.readouterr().err
    assert warned is (of_run == 'DICT_5X5_100')


def test_refine_refuses_the_calibration_of_a_smaller_image(path, photographed, capsys):
    # It gave a map with a marker in quarantine, and status 0.
    small = replace(CAMERA, width=CAMERA.width // 2, height=CAMERA.height // 2)
    save_camera(path.with_name('camera.yaml'), small)
    before = path.read_text()
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 2
    assert f'outside the {small.width}x{small.height} pixels of the calibration' in capsys.readouterr().err
    assert path.read_text() == before


@pytest.mark.parametrize('sides', [0.003, 0.03])
def test_refine_knows_the_sides_as_well_as_the_run_says(path, poses, photographed, sides):
    """It took 0.3 % for any run, and its claim of a map of carelessly printed markers was as narrow as of cut ones."""
    folder = path.with_name('run')
    folder.mkdir()
    file, *calibration = photographed
    file.rename(folder / 'detections.csv')
    (folder / 'parameters.yaml').write_text(f'/marker_mapper: {{ros__parameters: {{marker_size_std: {sides}}}}}')
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    assert run('--marker-size', SIZE, 'refine', path, folder, *calibration) == 0
    far = max(
        load_map(path).markers.values(), key=lambda marker: np.linalg.norm((marker.T_map_marker - poses[0])[:3, 3])
    )
    arm = np.linalg.norm((far.T_map_marker - poses[0])[:3, 3])
    # Along the arm from the fixed marker it is nearly all of the error: lens and corners leave a few millimetres.
    claimed = np.sqrt(np.trace(far.covariance[:3, :3]))
    assert sides * arm < claimed < sides * arm + 0.01


@pytest.mark.parametrize('said', ['by the run', 'by the map', 'by nobody'])
def test_refine_never_guesses_the_side_of_a_marker(path, poses, tmp_path, capsys, said):
    """It took that of the default parameters: markers of 0.4 m came out 0.6 m off, and the map was called sound."""
    folder, side = tmp_path / 'run', 0.4
    folder.mkdir()
    save_camera(folder / 'camera.yaml', CAMERA)
    (folder / 'detections.csv').write_text(detections(poses, side))
    markers = {0: MapMarker(0, side, True, poses[0])}
    if said == 'by the run':
        (folder / 'parameters.yaml').write_text(
            '/marker_mapper: {ros__parameters: {marker_size: 0.4, marker_size_overrides: []}}'
        )
    if said != 'by the map':
        markers[99] = MapMarker(99, 0.2, True, transform(np.eye(3), [50.0, 0.0, 0.0]))
    save_map(path, MarkerMap(markers, dictionary='STENCIL_4X4_100'))
    status = run('refine', path, folder, '--calibration', folder / 'camera.yaml')
    if said == 'by nobody':
        assert status == 2
        assert 'have no known side: give --marker-size' in capsys.readouterr().err
        return
    assert status == 0
    refined = load_map(path)
    for i, pose in poses.items():
        assert refined.markers[i].size == side
        # As above: tenths of a millimetre.
        assert np.linalg.norm(difference(refined.markers[i].T_map_marker, pose)[:3]) < 2e-3


def test_refine_overwrites_no_edit_that_was_made_meanwhile(path, poses, photographed, capsys, monkeypatch):
    def edited_meanwhile(*arguments):
        assert run('move', path, 3, '--position', 1, 2, 3) == 0
        return build_map(*arguments)

    monkeypatch.setattr(map_sources, 'build_map', edited_meanwhile)
    assert run('refine', path, *photographed) == 2
    assert 'changed by another program meanwhile' in capsys.readouterr().err
    np.testing.assert_allclose(load_map(path).markers[3].T_map_marker[:3, 3], [1.0, 2.0, 3.0])
    out = path.with_name('refined.yaml')
    assert run('refine', path, *photographed, '--out', out) == 0
    assert load_map(out).markers.keys() == poses.keys()


def test_refine_of_a_map_without_markers_says_so(path, photographed, capsys):
    save_map(path, MarkerMap())
    assert run('refine', path, *photographed, '--marker-size', SIZE) == 2
    printed = capsys.readouterr().out
    assert 'the map has no marker' in printed
    assert 'fixed' not in printed


def test_refine_moves_entries_that_somebody_wrote_by_hand(path, poses, photographed, capsys):
    rng = np.random.default_rng(5)
    entries = {}
    for i, pose in poses.items():
        T = pose.copy()
        T[:3, 3] += rng.normal(0.0, 0.05, 3) if i else 0.0
        entries[i] = MapMarker(i, SIZE, i == 0, T)
    save_map(path, MarkerMap(entries))
    assert run('check', path) == 1
    assert run('refine', path, *photographed) == 0
    refined = load_map(path)
    for i, pose in poses.items():
        # As above: tenths of a millimetre, where by hand they were some 90 mm off.
        assert np.linalg.norm(difference(refined.markers[i].T_map_marker, pose)[:3]) < 2e-3
        assert i == 0 or np.any(refined.markers[i].covariance)
    assert f'{path}: sound' in capsys.readouterr().out


def test_a_few_bad_views_do_not_make_the_error_that_is_printed(path, poses, photographed, capsys):
    """Two of some 200 views 10 px off: their root mean square is 1 px, where corners are good to 0.02."""
    file = photographed[0]
    head, *lines = file.read_text().split('\n')
    for index in (20, 90):
        cells = lines[index].split(',')
        cells[2:10] = [str(float(cell) + 10.0 * (-1) ** k) for k, cell in enumerate(cells[2:10])]
        lines[index] = ','.join(cells)
    file.write_text('\n'.join([head, *lines]))
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    # The size behind the action, elsewhere before it.
    assert run('refine', path, *photographed, '--marker-size', SIZE) == 0
    words = r're-projection error, median of the views: ([\d.]+) px, at worst ([\d.]+) px \(marker \d\)'
    printed = re.search(words, capsys.readouterr().out)
    # Corners of 0.02 px, less what the camera's pose of each frame takes up.
    assert 0.005 < float(printed[1]) <= float(printed[2]) < 0.04


def test_refine_reports_a_map_of_fixed_markers(path, poses, photographed, capsys):
    save_map(path, MarkerMap({key: MapMarker(key, SIZE, True, poses[key]) for key in range(8)}))
    assert run('refine', path, *photographed) == 0
    assert 'all markers are fixed: none was moved (map unfix)' in capsys.readouterr().out


def test_refine_prints_the_doubts_and_returns_2_if_one_spoils_the_map(path, poses, photographed, capsys):
    save_map(path, MarkerMap({0: MapMarker(0, SIZE, True, poses[0]), 40: MapMarker(40, SIZE, True, poses[0])}))
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 2
    said = capsys.readouterr().out
    assert 'markers 0 and 40 overlap' in said
    assert run('check', path) == 1
    assert said.endswith(capsys.readouterr().out)
    # Not seen once and far from all others: doubtful, but nobody flies worse by it.
    away = poses[0].copy()
    away[:3, 3] += 5.0
    start = {0: MapMarker(0, SIZE, True, poses[0]), 41: MapMarker(41, SIZE, False, away)}
    save_map(path, MarkerMap(start))
    assert run('--marker-size', SIZE, 'refine', path, *photographed) == 0
    assert 'marker 41: known to 0.17 m only' in capsys.readouterr().out


@pytest.mark.parametrize('sizes', [(0.1, 0.5), (0.5, 0.1)])
@pytest.mark.parametrize(('apart', 'overlap'), [(0.14, True), (0.16, False)])
def test_whether_markers_overlap_does_not_depend_on_their_ids(sizes, apart, overlap):
    places = np.eye(4), transform(np.eye(3), [apart, 0.0, 0.0])
    markers = {key: MapMarker(key, sizes[key], True, T) for key, T in enumerate(places)}
    said = [doubt.text for doubt in doubts(MarkerMap(markers))]
    assert [text[:23] for text in said] == ['markers 0 and 1 overlap'] * overlap


def test_markers_far_from_all_others_are_doubted():
    """A marker 300 m off, a slip of a survey, was in a map without a doubt."""
    places = [0.0, 2.0, 4.0, 90.0, 180.0, 400.0]
    markers = {k: MapMarker(k, 0.1, True, transform(np.eye(3), [x, 0.0, 1.0])) for k, x in enumerate(places)}
    # 0.1 m is seen from 50 m: one camera sees two that are 90 m apart.
    (text,) = (doubt.text for doubt in doubts(MarkerMap(markers)))
    assert text == 'marker 5: 220 m from all others, no camera sees both: positions are in metres'
    hall = {k + 10: MapMarker(k + 10, 0.1, True, transform(np.eye(3), [500.0, k, 1.0])) for k in range(7)}
    said = [doubt.text for doubt in doubts(MarkerMap(markers | hall))]
    assert said == ['markers 0, 1, 2, 3, 4: 220 m from all others, no camera sees both: positions are in metres']


def test_large_residuals_of_all_markers_name_the_calibration(poses):
    def said(errors):
        markers = {
            i: MapMarker(i, SIZE, i == 0, T, 1e-6 * np.eye(6), reprojection_error_px=error)
            for (i, T), error in zip(poses.items(), errors, strict=True)
        }
        return [doubt.text for doubt in doubts(MarkerMap(markers)) if 'calibration' in doubt.text]

    assert 'errors of 0.9 px or more: the likely cause is a calibration' in said([0.9] * 7 + [3.0])[0]
    # One or two markers with wrong views are no fault of the camera.
    assert said([0.1] * 6 + [3.0] * 2) == []


def room_cloud(rng, count=60_000):
    """Points of a room's floor and three walls around the markers, with 5 mm noise."""
    u, v = rng.uniform(-4.0, 4.0, (2, count))
    side = rng.integers(0, 4, count)
    points = np.select(
        [side[:, None] == k for k in range(4)],
        [
            np.stack([0 * u, u, 0.5 * v + 2.0], axis=-1),
            np.stack([u - 4.0, 0 * v + 4.0, 0.5 * v + 2.0], axis=-1),
            np.stack([u - 4.0, 0 * v - 4.0, 0.5 * v + 2.0], axis=-1),
            np.stack([u - 4.0, v, 0 * v], axis=-1),
        ],
    )
    return points + 0.005 * rng.normal(size=points.shape)


def write_ply(path, points):
    header = f'ply\nformat ascii 1.0\nelement vertex {len(points)}\n'
    header += ''.join(f'property float {axis}\n' for axis in 'xyz') + 'end_header\n'
    path.write_text(header + '\n'.join(' '.join(f'{v:.5f}' for v in p) for p in points) + '\n')


def test_align_finds_the_map_in_a_cloud(tmp_path, capsys):
    pytest.importorskip('small_gicp')
    pytest.importorskip('plyfile')
    rng = np.random.default_rng(6)
    facing = {  # on the wall x = 0, on either side wall, on the floor
        1: transform(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), [0.0, 0.5, 1.5]),
        2: transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), [-2.0, 4.0, 1.2]),
        3: transform(np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), [-3.0, -4.0, 1.8]),
        4: transform(np.eye(3), [-2.0, 0.0, 0.0]),
        5: transform(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), [0.0, -2.0, 2.2]),
    }
    T_cloud_map = transform(so3_exp([0.02, -0.01, 0.03]), [0.10, -0.05, 0.08])
    markers = {i: MapMarker(i, 0.3, i == 1, inverse(T_cloud_map) @ T, 1e-8 * np.eye(6)) for i, T in facing.items()}
    save_map(tmp_path / 'map.yaml', MarkerMap(markers))
    write_ply(tmp_path / 'room.ply', room_cloud(rng))
    arguments = ('--cloud', tmp_path / 'room.ply', '--out', tmp_path / 'T.yaml', '--plot', tmp_path / 'both.png')
    assert run('align', tmp_path / 'map.yaml', *arguments) == 0
    printed = capsys.readouterr().out
    assert 'open' not in printed.replace(str(tmp_path), '')  # parallel tests have it in their folder's name
    position = np.array([float(v) for v in printed.split('position ')[1].split(' orientation')[0].split()])
    # A plane of 70 points of 5 mm noise is known to 0.6 mm; over the 0.7 m between the two markers of the first wall
    # that is 1 mrad, or 4 mm at the origin 4 m away.
    np.testing.assert_allclose(position, T_cloud_map[:3, 3], atol=1.2e-2)
    assert (tmp_path / 'both.png').stat().st_size > 1000
    assert (tmp_path / 'T.yaml').read_text().startswith('parent: room.ply')


def test_align_along_a_lone_wall_reports_the_unobservable_directions(tmp_path, poses, capsys):
    pytest.importorskip('small_gicp')
    pytest.importorskip('plyfile')
    rng = np.random.default_rng(7)
    flat = wall(rng, tilt=0.0)
    for T in flat.values():
        T[0, 3] = 0.05
    points = np.stack([0.003 * rng.normal(size=20_000), *rng.uniform(-3.0, 4.0, (2, 20_000))], axis=-1)
    save_map(tmp_path / 'map.yaml', MarkerMap({i: MapMarker(i, 0.3, True, T) for i, T in flat.items()}))
    write_ply(tmp_path / 'wall.ply', points)
    assert run('align', tmp_path / 'map.yaml', '--cloud', tmp_path / 'wall.ply') == 0
    printed = capsys.readouterr().out
    assert '3 of 6 directions open' in printed
    position = np.array([float(v) for v in printed.split('position ')[1].split(' orientation')[0].split()])
    # It moved by the 5 cm towards the wall and not along it.
    np.testing.assert_allclose(position, [-0.05, 0.0, 0.0], atol=5e-3)


def test_corners_of_the_map_are_those_of_the_markers():
    T = transform(so3_exp([0.2, 0.1, 0.3]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(corners_in_map(T, 0.4)[0], apply(T, np.array([[-0.2, 0.2, 0.0]]))[0])


@pytest.mark.parametrize(('turn', 'inverted'), [(0.0, True), (np.pi, False)])
def test_the_drawing_shows_the_faces_as_the_camera_sees_them(poses, turn, inverted):
    """Whoever looks along x at markers that face him has y on his left; on the opposite wall, on his right."""
    turned = transform(so3_exp([0.0, 0.0, turn]), np.zeros(3))
    markers = {i: MapMarker(i, 0.3, True, turned @ T) for i, T in poses.items()}
    front = draw_map(MarkerMap(markers)).axes[2]
    assert front.xaxis_inverted() == inverted
    assert ('along x' in front.get_title()) == inverted


def test_all_of_a_drawing_is_within_the_picture(poses):
    # Two metres by two and one high: the drawing from above is as high as the picture.
    places = [2.8, 0.7, 1.5], [4.4, 0.36, 0.8], [4.1, 0.33, 1.65], [2.9, -0.7, 0.97], [3.8, -0.93, 1.6]
    turned = [transform(so3_exp([0.0, 0.0, 0.2]) @ poses[2][:3, :3], place) for place in places]
    markers = {i: MapMarker(i, 0.3, True, T, covariance=1e-5 * np.eye(6)) for i, T in enumerate(turned)}
    figure = draw_map(MarkerMap(markers))
    FigureCanvasAgg(figure).draw()
    for axis in figure.axes:
        assert axis.title.get_window_extent().y1 <= figure.bbox.y1
        assert axis.xaxis.label.get_window_extent().y0 >= figure.legends[0].get_window_extent().y1


def test_labels_of_a_drawing_of_one_wall_stand_apart(poses):
    # Eight markers over 6 m, 12 cm out of their plane: seen from the side they are a line.
    places = [[4.0 + 0.017 * k, 0.9 * k - 3.0, 0.2 * k] for k in range(8)]
    markers = {k: MapMarker(k, 0.3, True, transform(poses[2][:3, :3], place)) for k, place in enumerate(places)}
    figure = draw_map(MarkerMap(markers))
    FigureCanvasAgg(figure).draw()
    for axis in figure.axes:
        boxes = [label.get_window_extent() for label in axis.get_xticklabels() if label.get_text()]
        low, high = axis.get_window_extent().intervalx
        shown = sorted((box for box in boxes if low <= box.x0 + box.width / 2 <= high), key=lambda box: box.x0)
        assert shown
        assert all(left.x1 < right.x0 for left, right in pairwise(shown))


@pytest.mark.parametrize(('sigma', 'scale'), [(1e-3, ' enlarged 20 times'), (0.05, ' enlarged 2 times'), (0.5, '')])
def test_ellipses_of_a_drawing_leave_its_markers_to_be_seen(poses, sigma, scale):
    """A map from photos of a room, known to 6 cm: ellipses enlarged 20 times were 7 m wide, all over the drawing."""
    places = [[4.0, 0.8 * k, 0.0] for k in range(6)]
    markers = {
        k: MapMarker(k, 0.3, False, transform(poses[2][:3, :3], place), covariance=sigma**2 * np.eye(6))
        for k, place in enumerate(places)
    }
    assert draw_map(MarkerMap(markers)).legends[0].get_title().get_text().endswith(f'three sigma{scale}')


@pytest.mark.parametrize('action', ['history', 'undo'])
def test_a_folder_has_no_earlier_versions(action, tmp_path, monkeypatch, capsys):
    """A path without a name ended in a traceback."""
    monkeypatch.chdir(tmp_path)
    for folder in ('.', '/'):
        assert status(['map', action, folder]) == 2
        assert f'map: {folder}: is a folder, not a file' in capsys.readouterr().err


def test_a_link_to_itself_is_reported(path, tmp_path, capsys):
    """It ended in a traceback where the path of the link is looked for."""
    loop = tmp_path / 'loop'
    loop.symlink_to(loop)
    assert status(['map', 'align', loop, '--cloud', path, '--out', tmp_path / 'aligned.yaml']) == 2
    error = capsys.readouterr().err
    assert str(loop) in error
    assert 'Too many levels of symbolic links' in error
