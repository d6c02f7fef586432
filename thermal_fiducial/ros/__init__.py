"""What nodes are made of besides the core: messages, a base of all nodes, and the parts of each node."""
