"""The commands of ``python -m thermal_fiducial``."""
