"""Offline map tools: building from photos and recordings, editing, plausibility checks, alignment to point clouds."""
