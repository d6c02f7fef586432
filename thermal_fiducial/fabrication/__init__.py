"""Markers that can be cut."""
