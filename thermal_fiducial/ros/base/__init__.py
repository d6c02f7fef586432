"""The base of all nodes: parameters, QoS, rates of inputs, diagnostics, console lines."""
