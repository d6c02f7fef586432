"""The four nodes: convert, one core call, publish. Run them with ``ros2 run thermal_fiducial NODE``."""
