"""Records that cross from stage to stage: nobody changes them, neither who received nor who made them."""

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from support import small_bag

from thermal_fiducial.core.measurements import CameraPose, ImuSample, MARKER_DTYPE, Observations
from thermal_fiducial.core.pipeline import Pipeline, PipelineConfig
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import load_dictionary


def arrays(value):
    """All arrays in a record, however deep."""
    if isinstance(value, np.ndarray):
        yield value
    elif is_dataclass(value):
        yield from arrays([getattr(value, item.name) for item in fields(value)])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from arrays(item)


class Sealed:
    """Makes arrays read-only, and remembers what they held."""

    def __init__(self):
        self.copies = []

    def __call__(self, value):
        for array in arrays(value):
            array.setflags(write=False)
            if array.dtype != object:
                self.copies.append((array, array.copy()))
        return value


def sealing(method, sealed):
    """The ``method``, of which arguments and result are sealed."""

    def sealed_method(*arguments):
        return sealed(method(*sealed(arguments)))

    return sealed_method


def test_no_stage_changes_what_it_received_or_has_handed_on():
    config = PipelineConfig.from_mapping(small_bag.PARAMETERS)
    start = small_bag.map_of(dict(list(small_bag.CENTRES.items())[:2]))
    pipeline = Pipeline(config, load_dictionary('DICT_4X4_50'), start, small_bag.CAMERA)
    sealed = Sealed()
    for stage, names in (
        (pipeline.cleaner, ['process']),
        (pipeline.detector, ['detect']),
        (pipeline.mapper, ['locate', 'learn', 'snapshot', 'apply']),
        (pipeline.filter, ['add_imu', 'add_pose']),
    ):
        for name in names:
            setattr(stage, name, sealing(getattr(stage, name), sealed))
    rng = np.random.default_rng(0)
    for k in range(400):
        stamp = small_bag.START_NS + k * 5_000_000
        values = small_bag.true_imu(k * 0.005)
        pipeline.add_imu(ImuSample(stamp, values[:3], values[3:]))
        if k % 7 == 0:
            pipeline.add_image(stamp, small_bag.frame(small_bag.true_pose(k * 0.005), rng))
    assert pipeline.filter.status == 'tracking'
    assert len(pipeline.mapper.map.markers) == len(small_bag.CENTRES)
    assert len(sealed.copies) > 1000
    for array, copy in sealed.copies:
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize(
    ('kind', 'values', 'words'),
    [
        (ImuSample, (0, [0.0] * 3, np.zeros(3)), r'angular_velocity is a list of shape \(3,\), not a numpy array'),
        (ImuSample, (0, np.zeros(3), np.zeros((3, 1))), r'linear_acceleration is a ndarray of shape \(3, 1\)'),
        (ImuSample, (0.005, np.zeros(3), np.zeros(3)), 'ImuSample: stamp_ns 0.005 is not an integer of nanoseconds'),
        (CameraPose, (0, np.zeros(7), np.eye(6)), r'T_map_camera is a ndarray of shape \(7,\)'),
        (CameraPose, (0, np.eye(4), np.ones(36)), r'CameraPose: covariance is a ndarray of shape \(36,\), not'),
        (CameraPose, (0, np.eye(4), np.eye(6), np.eye(3)), 'map_covariance'),
        (
            ImuSample,
            (0, np.array(['a', 'b', 'c']), np.zeros(3)),
            'angular_velocity is an array of <U1, not of real numbers',
        ),
        (ImuSample, (0, np.zeros(3), np.zeros(3, complex)), 'linear_acceleration is an array of complex128, not of'),
        (CameraPose, (0, np.full((4, 4), None), np.eye(6)), 'T_map_camera is an array of object, not of real numbers'),
    ],
)
def test_a_record_of_other_shapes_kinds_or_units_of_time_is_refused(kind, values, words):
    with pytest.raises(InputError, match=words):
        kind(*values)


@pytest.mark.parametrize('integer', [int, np.int64, np.uint64])
def test_stamps_may_be_any_integers_of_numpy(integer):
    """Differences of unsigned ones are never negative: all poses were far ahead of the IMU."""
    pose = CameraPose(integer(5_000_000_000), np.eye(4), np.eye(6))
    assert pose.stamp_ns - 7_000_000_000 == -2_000_000_000
    assert ImuSample(integer(5), np.zeros(3), np.zeros(3)).stamp_ns + -7 == -2


@pytest.mark.parametrize('stamp', [1.5, None, '1'])
def test_images_have_stamps_of_whole_nanoseconds(stamp):
    """Stamps in seconds were taken for nanoseconds: the velocity between two frames is beyond all bounds then."""
    pipeline = Pipeline(PipelineConfig(), load_dictionary('DICT_4X4_50'), small_bag.map_of([0]), small_bag.CAMERA)
    picture = np.full((512, 640), 7000, np.uint16)
    for take in (pipeline.add_image, lambda stamp, counts: pipeline.detector.detect(stamp, counts, small_bag.CAMERA)):
        with pytest.raises(InputError, match=f'image: stamp_ns {stamp!r} is not an integer of nanoseconds'):
            take(stamp, picture)


@pytest.mark.parametrize('markers', [[], np.zeros((4, 2)), np.zeros(2, MARKER_DTYPE).tolist()])
def test_what_is_no_row_of_markers_is_refused(markers):
    with pytest.raises(InputError, match='no rows of MARKER_DTYPE'):
        Observations.of(markers)
