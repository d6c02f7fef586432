"""Errors against ground truth, tables, plots and the HTML report."""
