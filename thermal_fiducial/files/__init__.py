"""Files that the package reads and writes: bags, maps, calibrations, trajectories, run folders."""
