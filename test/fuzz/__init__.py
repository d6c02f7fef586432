"""Mutated messages, files and bags for the real nodes and commands; every input follows from its kind and number."""
