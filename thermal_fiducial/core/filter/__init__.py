"""The parts of the filter: error state, IMU propagation, gate, start, output."""
