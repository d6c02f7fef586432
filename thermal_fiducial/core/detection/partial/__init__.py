"""Known markers that are partially visible: found by their visible cells, measured by the edges between these."""
