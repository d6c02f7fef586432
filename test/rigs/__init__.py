"""Random rigs, rooms and motions, from pictures on; what renders, moves and measures is not the package's own code."""
