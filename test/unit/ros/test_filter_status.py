"""What the filter's node says of its filter."""

from types import SimpleNamespace
from unittest.mock import Mock

from thermal_fiducial.core.filter.output import TRACKING
from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.ros.base.node import OK, WARN
from thermal_fiducial.ros.filter_node.filter_status import FilterStatus


def test_a_turned_camera_is_a_warning():
    imu = SimpleNamespace(level=lambda: OK, complaint=str, headline=str)
    filter_ = SimpleNamespace(condition=TRACKING, lost=False, doubts=[])
    status = FilterStatus(filter_, imu, Mock())
    assert status.state('') == (OK, 'tracking')
    assert status.headline() == 'initialised: tracking'
    filter_.doubts = [Condition('camera_orientation is off', 'by 2 deg'), Condition('the map leans', 'by 1 deg')]
    assert status.state('') == (WARN, 'tracking; camera_orientation is off: by 2 deg; the map leans: by 1 deg')
    assert status.headline() == 'initialised: tracking; camera_orientation is off; the map leans'
