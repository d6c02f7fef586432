"""Frames: extrinsics from TF or a URDF, the pose on /tf, the landing pad, poses when the map moves."""
