"""A node as a process: run loop, signals, priority, output, a second process for long computations."""
