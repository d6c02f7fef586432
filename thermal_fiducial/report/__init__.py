"""Reports: measures of a run, pictures, one HTML page; and what a flight controller would receive."""
