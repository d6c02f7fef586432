"""Where a drone is in smoke and fog: acrylic markers seen by a thermal camera, and an IMU.

The layers, each importing only from those below it (checked by import-linter)::

    cli                               commands
    replay                            recorded bags through the real nodes
    nodes     report                  four thin ROS 2 nodes; plots and HTML
    ros                               message <-> numpy, parameters, QoS, run loop
    sim  files  fabrication  calibration
    core                              the algorithms: no ROS, no files, no clock, no printing
    config  errors
"""

__version__ = '0.1.0'
