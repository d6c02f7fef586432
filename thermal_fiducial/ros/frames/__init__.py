"""Frames of the robot: extrinsics from TF or a URDF, the pose on /tf, the landing pad."""
