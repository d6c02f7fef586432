"""The parts of the incremental map: its data, its evidence, localization in it."""
