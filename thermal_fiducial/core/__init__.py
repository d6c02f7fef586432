"""The algorithms: numpy, OpenCV and filterpy; no ROS, no files, no clock, no printing."""
