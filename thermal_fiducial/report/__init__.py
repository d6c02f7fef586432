"""Reports: measures of a run, pictures, one HTML page; and checks of the outputs for a flight controller."""
