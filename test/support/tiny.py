"""A small, quick flight: one marker, 160 x 128 pixels, two seconds."""

from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scenario import Scenario
from thermal_fiducial.sim.scene import Marker
from thermal_fiducial.sim.spline_trajectory import Flight

LENS = Lens((190.0, 189.0), (81.3, 62.4), 'plumb_bob', (-0.25, 0.09, 4e-4, -3e-4, 0.0), 160, 128)

TINY = Scenario(
    'tiny',
    'a test flight',
    (Marker(5, (2.0, 0.0, 0.7), 180.0, 5.0, 8.0), Marker(7, (2.6, -0.5, 0.8), 170.0, 0.0, 0.0, 0.25)),
    lens=LENS,
    flight=Flight(ground_time=0.3, climb_time=0.5, hover_time=0.15, height=0.1),
    seconds=2.5,
)
