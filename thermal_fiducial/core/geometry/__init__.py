"""Rigid motions, cameras, poses of planar markers and their covariances."""
