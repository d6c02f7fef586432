"""Faults in flight, one after another, and what the nodes make of each."""
