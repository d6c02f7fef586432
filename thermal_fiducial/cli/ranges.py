"""Ranges of numbers on the command line. None holds NaN, infinity, or what no plate, board, camera or room has."""

from thermal_fiducial.cli.subcommands import number, whole_number

#: Length of a sheet or between cuts: the widest sheets of acrylic are 2 to 3 m.
LENGTH_MM = number(0.0, 10_000.0, 'mm')
#: Length that a target must have, up to a wall.
BOARD_MM = number(0.1, 10_000.0, 'mm')
#: Points, or circles, along a side of a target; and by how many a row may be longer.
BOARD_POINTS, MORE_POINTS = whole_number(1, 100), whole_number(0, 100)
#: Side of an image, and focal length of a lens, from a fish-eye on the smallest sensor to a telescope.
IMAGE_PX, FOCAL_PX = whole_number(32, 65_535), number(10.0, 100_000.0, 'px')
#: Focal length, of which a smaller number is probably in metres.
LENS_MM = 0.5, 1_000.0
#: Side of a marker: from a grain of dust, which is no marker, to a house.
SIDE_M = 1e-3, 100.0
#: Bits along a side of a marker: those of dictionaries are 4 to 7.
BITS = whole_number(3, 16)
#: Noise of thermal cameras: 0.02 to 0.1 K.
NETD_K = number(1e-3, 10.0, 'K')
#: Warm surface above the room, up to a glowing one.
CONTRAST_K = 0.01, 400.0
#: Extinction, up to smoke in which a hand at the camera is hidden.
FOG_PER_M = 0.0, 100.0
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
