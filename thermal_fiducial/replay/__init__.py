"""Replays recorded bags through the real nodes: in lock-step in one process, or one process a node in real time."""
