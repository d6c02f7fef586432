"""What every node shares: message <-> numpy, parameters, QoS, the run loop. See :mod:`thermal_fiducial.ros.node`."""
