"""Messages to records and back, checked; nothing here needs a node."""
