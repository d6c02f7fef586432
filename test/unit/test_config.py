"""Parameters: complete metadata, and refusal of what doesn't fit."""

import ast
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from thermal_fiducial import config
from thermal_fiducial.config import (
    ArucoDetectorConfig,
    check_names,
    from_mapping,
    group,
    ImuNoise,
    LandingTargetConfig,
    local_path,
    MarkerMapperConfig,
    param,
    parameters,
    PoseEkfConfig,
    SelfChecked,
    size_overrides,
    Tau2CameraConfig,
    ThermalSourceConfig,
)
from thermal_fiducial.errors import InputError

NODES = (
    Tau2CameraConfig,
    ArucoDetectorConfig,
    MarkerMapperConfig,
    PoseEkfConfig,
    ThermalSourceConfig,
    LandingTargetConfig,
)


@dataclass(frozen=True)
class Inner(SelfChecked):
    gain: float = param(1.0, 'Gain.', unit='1', minimum=0.0, maximum=2.0)


@dataclass(frozen=True)
class Example(SelfChecked):
    name: str = param('a', 'Name.', choices=('a', 'b'))
    count: int = param(3, 'Count.', minimum=1)
    flag: bool = param(False, 'Flag.')
    place: tuple[float, ...] = param((0.0, 0.0), 'Place.', unit='m', length=2, minimum=-5.0)
    turn: tuple[float, ...] = param((0.0, 1.0), 'Turn.', length=2, normed=True)
    words: tuple[str, ...] = param((), 'Words.')
    ids: tuple[int, ...] = param((), 'IDs.')
    inner: Inner = group(Inner)  # noqa: RUF009


@pytest.mark.parametrize('kind', NODES)
def test_defaults_pass_their_own_checks_and_are_described(kind):
    for name, item, default in parameters(kind):
        assert config.checked(name, item, default) == default
        assert item.metadata['description'].split(' [')[0].endswith('.'), name
    assert from_mapping(kind, {}) == kind()


def test_names_shared_by_nodes_have_one_meaning():
    seen = {}
    for kind in NODES:
        for name, item, default in parameters(kind):
            meaning = default, *(item.metadata[key] for key in ('minimum', 'maximum', 'choices', 'length'))
            assert seen.setdefault(name, meaning) == meaning, name


@pytest.mark.parametrize('kind', NODES)
def test_what_a_parameter_needs_are_other_parameters_of_its_node(kind):
    names = {name for name, _, _ in parameters(kind)}
    for name, item, _ in parameters(kind):
        assert set(item.metadata['needs']) <= names - {name}


@pytest.mark.parametrize(
    ('values', 'lines'),
    [
        (PoseEkfConfig(), []),
        (PoseEkfConfig(odom_frame='odom', publish_tf=True, smoothing_time=0.5), []),
        (PoseEkfConfig(odom_frame='odom', publish_tf=True), ['odom_frame: no effect without smoothing_time']),
        (PoseEkfConfig(odom_frame='odom'), ['odom_frame: no effect without publish_tf and smoothing_time']),
        (
            PoseEkfConfig(estimate_time_offset=False, time_offset_random_walk=1e-3, px4=True),
            ['time_offset_random_walk: no effect without estimate_time_offset', 'px4: no effect without bridge_rate'],
        ),
        (MarkerMapperConfig(autosave_period=5.0), ['autosave_period: no effect without map_file']),
        (
            MarkerMapperConfig(second_camera_position=(0.0, 0.0, 1.0), cloud_alignment_file='a.yaml'),
            [
                'second_camera_position: no effect without second_camera',
                'cloud_alignment_file: no effect without cloud_file',
            ],
        ),
        (ArucoDetectorConfig(guided=False), []),
        (
            ArucoDetectorConfig(guided=False, guided_min_contrast=0.3),
            ['guided_min_contrast: no effect without guided'],
        ),
    ],
)
def test_parameters_without_effect_are_named(values, lines):
    assert config.without_effect(values) == [f'parameter {line}' for line in lines]


def test_markers_that_the_dictionary_lacks_are_named():
    values = ArucoDetectorConfig(whitelist=(3, 77, -1), marker_size_overrides=('49:0.1', '50:0.2'))
    assert config.unknown_markers(values, 50) == [
        'parameter whitelist: DICT_4X4_50 has no marker 77, -1',
        'parameter marker_size_overrides: DICT_4X4_50 has no marker 50',
    ]
    assert config.unknown_markers(values, 1000) == ['parameter whitelist: DICT_4X4_50 has no marker -1']


def test_no_constructor_keeps_a_dynamic_parameter():
    # What it keeps would stay as it is when the parameter is set in flight.
    dynamic = {name for kind in NODES for name, item, _ in parameters(kind) if item.metadata['dynamic']}
    read, kept = set(), []
    for file in Path(config.__file__).parent.rglob('*.py'):
        for function in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
            if not isinstance(function, ast.FunctionDef):
                continue
            for node in ast.walk(function):
                if isinstance(node, ast.Attribute) and node.attr in dynamic and 'config' in ast.unparse(node.value):
                    read.add(node.attr)
                    kept += [f'{file.name}: {node.attr}'] if function.name in ('__init__', '__post_init__') else []
    assert kept == []
    assert read == dynamic


@pytest.mark.parametrize('kind', NODES)
def test_no_number_may_be_infinite_or_nearly_a_division_by_zero(kind):
    """Infinite standard deviations keep the filter from starting, 1e-300 Hz ends its node."""
    for name, item, default in parameters(kind):
        if not isinstance(default, float):
            continue
        with pytest.raises(InputError):
            from_mapping(kind, {name: float('inf')})
        unit = item.metadata['unit']
        if unit == 'Hz' or name == 'autosave_period':
            with pytest.raises(InputError, match=f'{name}: 1e-300 is neither 0 nor at least .* {unit}'):
                from_mapping(kind, {name: 1e-300})


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('extrinsics_position_std', 2.0),  # mm
        ('extrinsics_orientation_std', 2.0),  # degrees
        ('imu.gyroscope_range', 2000.0),  # degrees a second
        ('initial_gyroscope_bias_std', 5.0),  # degrees a second
        ('max_imu_gap', 1000.0),  # ms
        ('smoothing_time', 100.0),  # ms
        ('lost_position_std', 300.0),  # mm
    ],
)
def test_numbers_of_the_filter_in_other_units_are_refused(name, value):
    with pytest.raises(InputError, match=f'parameter {name}: {value} is outside'):
        from_mapping(PoseEkfConfig, {name: value})


def test_parameters_of_a_class_and_of_an_instance():
    assert [name for name, _, _ in parameters(Example)] == [
        'name',
        'count',
        'flag',
        'place',
        'turn',
        'words',
        'ids',
        'inner.gain',
    ]
    changed = from_mapping(Example, {'inner.gain': 0.5})
    assert {name: value for name, _, value in parameters(changed)}['inner.gain'] == 0.5


def test_values_take_the_place_of_defaults_and_names_of_others_are_left_alone():
    made = from_mapping(Example, {'name': 'b', 'place': [1, 2.5], 'words': ['x'], 'inner.gain': 2, 'other': object()})
    assert made == Example(name='b', place=(1.0, 2.5), words=('x',), inner=Inner(2.0))
    assert isinstance(made.inner.gain, float)


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'name': 'c'}, "parameter name: 'c' is not one of a, b"),
        ({'name': 3}, 'not of type str'),
        ({'count': 0}, 'outside 1 .. None'),
        ({'count': 2.0}, 'not of type int'),
        ({'count': True}, 'not of type int'),
        ({'flag': 1}, 'not of type bool'),
        ({'place': [1.0]}, '1 values, not 2'),
        ({'place': [1.0, 'x']}, "'x' is not a number"),
        ({'place': [1.0, -6.0]}, '-6.0 is outside'),
        ({'place': [1.0, float('nan')]}, 'nan is outside'),
        ({'place': 'ab'}, "'ab' is not a list"),
        ({'turn': [0.0, 0.0]}, 'no unit quaternion'),
        ({'turn': [0.6, float('nan')]}, 'no unit quaternion'),
        ({'words': 'ab'}, "'ab' is not a list"),
        ({'words': 7}, '7 is not a list'),
        ({'words': ['a', 7]}, '7 is not of type str'),
        ({'ids': [7.5]}, '7.5 is not of type int'),
        ({'ids': [True]}, 'True is not of type int'),
        ({'inner.gain': 2.1}, 'parameter inner.gain: 2.1 is outside 0.0 .. 2.0'),
        ({'inner.gain': float('nan')}, 'outside'),
        ({'inner.gain': False}, 'not a number'),
    ],
)
def test_what_does_not_fit_is_refused_by_name(values, words):
    with pytest.raises(InputError) as error:
        from_mapping(Example, values)
    assert words in str(error.value)
    assert str(error.value).startswith(f'parameter {next(iter(values))}')


@pytest.mark.parametrize(
    ('make', 'words'),
    [
        (lambda: PoseEkfConfig(gravity=12.0), 'parameter gravity: 12.0 is outside 9.7 .. 9.9'),
        (lambda: replace(PoseEkfConfig(), initial_poses=2.5), 'parameter initial_poses: 2.5 is not of type int'),
        (
            lambda: MarkerMapperConfig(marker_size=300.0),
            'parameter marker_size: 300.0 is outside 0.005 .. 10.0 m',
        ),
        (
            # A data sheet's 4 mdps/sqrt(Hz), and 160 ug/sqrt(Hz).
            lambda: ImuNoise(gyroscope_noise_density=4.0),
            'parameter gyroscope_noise_density: 4.0 is outside 0.0 .. 0.1 rad/s/sqrt(Hz)',
        ),
        (
            lambda: ImuNoise(accelerometer_noise_density=160.0),
            'parameter accelerometer_noise_density: 160.0 is outside 0.0 .. 1.0 m/s^2/sqrt(Hz)',
        ),
        # Wrong by 1000.
        (lambda: ImuNoise(gyroscope_noise_density=0.17), 'gyroscope_noise_density: 0.17 is outside'),
        (lambda: ImuNoise(accelerometer_noise_density=2.0), 'accelerometer_noise_density: 2.0 is outside'),
        (lambda: ImuNoise(gyroscope_random_walk=0.02), 'gyroscope_random_walk: 0.02 is outside'),
        (lambda: ImuNoise(accelerometer_random_walk=0.3), 'accelerometer_random_walk: 0.3 is outside'),
        # A data sheet's 0.25 mg.
        (lambda: ImuNoise(accelerometer_instability=0.25), 'accelerometer_instability: 0.25 is outside'),
        (lambda: ImuNoise(vibration=-1.0), 'parameter vibration: -1.0 is outside'),
        (lambda: ArucoDetectorConfig(marker_size_overrides=('7',)), 'parameter marker_size_overrides'),
        (lambda: ArucoDetectorConfig(marker_size_overrides=(7,)), 'parameter marker_size_overrides: 7 is not of type'),
        (lambda: MarkerMapperConfig(mode='surveying'), "parameter mode: 'surveying' is not one of"),
        # rclpy ends a node that subscribes to such a topic with a traceback.
        (lambda: MarkerMapperConfig(second_camera='2nd'), "second_camera: '2nd' is not the name of a namespace"),
        (lambda: MarkerMapperConfig(second_camera='looks down'), "'looks down' is not the name of a namespace"),
        (lambda: MarkerMapperConfig(second_camera='/down/'), "'/down/' is not the name of a namespace"),
    ],
)
def test_a_config_made_by_hand_checks_itself(make, words):
    with pytest.raises(InputError) as error:
        make()
    assert words in str(error.value)


def test_names_of_frames_begin_without_a_slash():
    """Those of ROS 1 have one, which is no part of the name: tf2 refuses it in what the nodes publish."""
    named = {
        (kind, name): getattr(kind(**{name: '/there'}), name)
        for kind in NODES
        for name, _, _ in parameters(kind)
        if name in ('base_frame', 'camera_frame', 'map_frame', 'odom_frame', 'frame_id')
    }
    assert len(named) == 14
    assert set(named.values()) == {'there'}


def test_a_path_may_begin_at_home(monkeypatch):
    monkeypatch.setenv('HOME', '/home/pilot')
    assert MarkerMapperConfig(map_file='~/hall.yaml').map_file == '/home/pilot/hall.yaml'
    camera = from_mapping(Tau2CameraConfig, {'calibration_file': '~/tau2.yaml', 'frame_id': '~camera'})
    assert camera.calibration_file == '/home/pilot/tau2.yaml'
    # What is no path stays.
    assert camera.frame_id == '~camera'


@pytest.mark.parametrize(
    ('given', 'path'),
    [
        ('file:///maps/hall.yaml', '/maps/hall.yaml'),
        ('file://localhost/maps/hall.yaml', '/maps/hall.yaml'),
        ('file:/maps/hall%201.yaml', '/maps/hall 1.yaml'),
        ('/maps/hall%201.yaml', '/maps/hall%201.yaml'),
        ('file:hall.yaml', 'file:hall.yaml'),
        ('file://other/hall.yaml', 'file://other/hall.yaml'),
        ('a[b', 'a[b'),
        ('//[a', '//[a'),
    ],
)
def test_a_file_may_be_a_url(given, path):
    """Of file:///maps/hall.yaml two slashes were lost, and file:/maps/hall.yaml was not found."""
    assert MarkerMapperConfig(map_file=given).map_file == path
    assert from_mapping(Tau2CameraConfig, {'calibration_file': given}).calibration_file == path


def test_every_file_is_a_path():
    files = {name for kind in NODES for name, _, _ in parameters(kind) if name.endswith('_file')}
    paths = {name for kind in NODES for name, item, _ in parameters(kind) if item.metadata['form'] is local_path}
    assert files
    assert paths == files | {'dictionary', 'camera'}


def test_a_config_takes_lists_and_whole_numbers_as_a_file_does():
    made = ArucoDetectorConfig(camera_position=[1, 0, 0], marker_size=1)
    assert made == from_mapping(ArucoDetectorConfig, {'camera_position': [1, 0, 0], 'marker_size': 1})
    assert made.camera_position == (1.0, 0.0, 0.0)


def test_a_name_that_no_node_has_is_refused_with_the_closest_one():
    with pytest.raises(
        InputError,
        match=r'noise_densty: no node has it; did you mean imu\.gyroscope_noise_density',
    ):
        check_names(['marker_size', 'imu.gyroscope_noise_densty'])
    with pytest.raises(InputError, match=r'parameter \\ufeffxyzzy: no node has it$'):
        check_names(['\ufeffxyzzy'])
    with pytest.raises(InputError, match=r'parameter xyzzy: no node has it$'):
        check_names(['xyzzy'])
    check_names(['gate', 'use_sim_time', 'qos_overrides./tf.publisher.depth'])


@pytest.mark.parametrize(
    ('changes', 'two'),
    [
        ({'camera_frame': 'base_link'}, 'base_frame and camera_frame'),
        ({'map_frame': '/base_link'}, 'map_frame and base_frame'),
        ({'odom_frame': 'map', 'publish_tf': True, 'smoothing_time': 1.0}, 'map_frame and odom_frame'),
    ],
)
def test_two_frames_of_one_name_are_refused(changes, two):
    """With the camera's that of the robot, any message on /tf_static put it into the IMU; others make loops of TF."""
    with pytest.raises(InputError, match=f'^parameters {two}: both are .*, and must be two frames$'):
        PoseEkfConfig(**changes)
    assert PoseEkfConfig(odom_frame='').odom_frame == ''


def test_size_overrides():
    assert size_overrides(()) == {}
    assert size_overrides(('7:0.5', '12:0.125')) == {7: 0.5, 12: 0.125}


@pytest.mark.parametrize('entry', ['7', '7:', ':0.5', 'a:0.5', '7:b', '7:0', '7:-1', '7:nan', '7:inf', '7:50'])
def test_a_broken_override_is_refused(entry):
    with pytest.raises(InputError, match='marker_size_overrides'):
        size_overrides((entry,))


def test_two_sides_of_one_marker_are_refused():
    """The last one counted, without a word, and poses were off by the ratio of the two."""
    with pytest.raises(InputError, match=r'^parameter marker_size_overrides: marker 7 is there twice$'):
        ArucoDetectorConfig(marker_size_overrides=('7:0.5', '12:0.125', '07:0.4'))
