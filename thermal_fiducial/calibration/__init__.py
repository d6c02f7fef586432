"""Intrinsics and camera-to-IMU calibration."""
