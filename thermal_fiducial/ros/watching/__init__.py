"""What watches running nodes: their topics and diagnostics, the outputs for an autopilot."""
