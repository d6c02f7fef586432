"""Corners from the edges of a marker, adjusted jointly."""
