"""Corners of found markers, by their sides or by their whole patterns, with their covariances."""
