"""Drivers of thermal cameras: V4L2, TeAx ThermalGrabber, and recorded pictures. They need no ROS."""
