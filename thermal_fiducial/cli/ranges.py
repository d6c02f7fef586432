"""Ranges of numbers on the command line. None holds NaN, infinity, or what no plate, board, camera or room has."""

from thermal_fiducial.cli.arguments import number, whole_number
from thermal_fiducial.config import LARGEST_SIDE, SMALLEST_SIDE
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE

#: Length of a sheet or between cuts: the widest sheets of acrylic are 2 to 3 m.
LENGTH_MM = number(0.0, 10_000.0, 'mm')
#: Length that a target must have, up to a wall.
BOARD_MM = number(0.1, 10_000.0, 'mm')
#: How well the points of a target are known, of which more leaves no shape of it.
BOARD_STD_MM = number(0.0, 100.0, 'mm')
#: Motion in the image from frame to frame, of which more shows another place.
MOTION_PX = number(0.0, 100.0, 'px')
#: Points, or circles, along a side of a target; and by how many a row may be longer.
BOARD_POINTS, MORE_POINTS = whole_number(1, 100), whole_number(0, 100)
#: Side of an image, and focal length of a lens, from a fish-eye on the smallest sensor to a telescope.
IMAGE_PX, FOCAL_PX = whole_number(32, 65_535), number(10.0, 100_000.0, 'px')
#: Focal length, of which a smaller number is probably in metres.
LENS_MM = number(0.5, 1_000.0, 'mm')
#: Side of a marker, as in the parameters and in maps: a larger number is probably in centimetres.
SIDE_M = number(SMALLEST_SIDE, LARGEST_SIDE, 'm')
#: Thickness of plates, of which a larger number is probably in millimetres.
PLATE_M = number(0.0, 0.05, 'm')
#: Marker IDs, above those of any dictionary.
MARKER_ID = whole_number(0, 99_999)
#: Bits along a side of a marker: those of dictionaries are 4 to 7.
BITS = whole_number(3, 16)
#: Hamming distance between markers, at most all bits of the largest.
HAMMING = whole_number(1, 256)
#: Warm ring around a marker, in cells.
CELLS = number(0.0, 100.0, 'cells')
#: Noise of thermal cameras: 0.02 to 0.1 K.
NETD_K = number(1e-3, 10.0, 'K')
#: Warm surface above the room, up to a glowing one.
CONTRAST_K = number(0.01, 400.0, 'K')
#: Extinction, up to smoke in which a hand at the camera is hidden.
FOG_PER_M = number(0.0, 100.0, '1/m')
#: Air gap behind a plate.
GAP_MM = number(0.0, 500.0, 'mm')
#: Heat transfer to the room: 10 in still air, 25 under rotors, 100 in a storm.
LOSS = number(0.1, 500.0, 'W/m2/K')
#: Time since something was switched on, up to a month.
AFTER_S = number(0.0, 2_600_000.0, 's')
#: Distance from which a marker is looked at.
DISTANCE_M = 1e-3, 10_000.0
#: Standard deviations of a place in a map, and of a turn.
SIGMA_M, SIGMA_DEG = number(0.0, 100.0, 'm'), number(0.0, 180.0, 'deg')
#: Coordinate in a map, and component of a quaternion.
COORDINATE_M, QUATERNION = number(-LARGEST_COORDINATE, LARGEST_COORDINATE, 'm'), number(-1.1, 1.1)
#: How far a map may lie from where it is looked for.
REACH_M = number(0.01, 100.0, 'm')
#: Angle between normal and line of sight; from behind a marker is not seen.
TILT_DEG = number(0.0, 89.0, 'deg')
#: Length of a simulated flight, and of a demo.
FLIGHT_S = number(1.0, 3_600.0, 's')
#: Time to listen to nodes.
LISTEN_S = number(0.01, 3_600.0, 's')
#: Speed of a replay, in multiples of real time.
RATE = number(0.001, 100.0)
#: Processes on one machine.
PROCESSES = whole_number(1, 256)
#: Thermal time constant of bolometers, and time from the first row of an image to the last.
LAG_S, READOUT_S = number(0.0, 0.1, 's'), number(0.0, 0.05, 's')
#: Frame rate of thermal cameras.
FRAME_HZ = number(1.0, 120.0, 'Hz')
#: Clock offset of the camera that a flight may have, and delay of its frames.
OFFSET_S, LATE_S = number(-1.0, 1.0, 's'), number(0.0, 10.0, 's')
#: Standard deviation of corners.
CORNER_PX = number(1e-3, 100.0, 'px')
#: Noise densities and random walks of an IMU, in the units of their parameters.
IMU_NOISE = number(0.0, 1.0)
