"""What all four nodes share: conversions, parameters, QoS, diagnostics, the run loop."""
