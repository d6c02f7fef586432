"""Seeing markers in a frame: search, reading, sharpening, rows."""
