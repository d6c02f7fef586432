"""Parts of ``pose_ekf``: queue of the IMU, outputs, outputs for autopilots, status, restart."""
