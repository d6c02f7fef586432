"""All stages in a row: what one stage keeps back, no later one can make good."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from support import small_bag

from thermal_fiducial.core.pipeline import Pipeline, PipelineConfig
from thermal_fiducial.files.dictionary import load_dictionary


def test_a_quarantined_marker_is_released_though_only_markers_of_the_map_may_be_found():
    config = PipelineConfig.from_mapping(small_bag.PARAMETERS | {'whitelist_from_map': True})
    start = small_bag.map_of(small_bag.CENTRES)
    knocked = max(start.markers)
    # Somebody has put it back since.
    start.markers[knocked] = replace(start.markers[knocked], trusted=False)
    pipeline = Pipeline(config, load_dictionary('DICT_4X4_50'), start, small_bag.CAMERA)
    rng = np.random.default_rng(0)
    for k in range(100):
        pipeline.add_image(small_bag.START_NS + k * 100_000_000, small_bag.frame(small_bag.true_pose(0.0), rng))
    assert pipeline.mapper.map.markers[knocked].trusted


def test_the_clock_offset_comes_with_poses_as_on_its_topic():
    """It may become known between two poses; a frame without one brings nothing."""
    pipeline = Pipeline(
        PipelineConfig.from_mapping(small_bag.PARAMETERS),
        load_dictionary('DICT_4X4_50'),
        small_bag.map_of(small_bag.CENTRES),
        small_bag.CAMERA,
    )
    pipeline.filter = SimpleNamespace(camera_time_offset=0.01, add_pose=lambda pose: None)
    detect, known, rng = pipeline.detector.detect, [], np.random.default_rng(0)
    pipeline.detector.detect = lambda *frame: known.append(frame[-1].clock_is_known) or detect(*frame)
    wall = small_bag.frame(small_bag.true_pose(0.0), rng)
    nothing = [rng.normal(7000.0, 4.0, wall.shape).astype(np.uint16) for _ in range(3)]
    for k, image in enumerate([*nothing[:2], wall, nothing[2]]):
        pipeline.add_image(small_bag.START_NS + k * 100_000_000, image)
    assert known == [False, False, False, True]
