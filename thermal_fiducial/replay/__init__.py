"""Recorded bags through the real nodes."""
