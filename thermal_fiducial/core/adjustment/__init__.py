"""Least squares on re-projection errors: closed forms, robust fits, normal equations."""
