"""Markers found in a frame: those of the last frame followed, known ones near their predictions, the rest searched."""
