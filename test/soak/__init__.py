"""Hours of flight through the nodes: memory, processor time, error, shutdown."""
