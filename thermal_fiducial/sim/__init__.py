"""A Tau 2 and an IMU seen through physics, independent of the code under test."""
