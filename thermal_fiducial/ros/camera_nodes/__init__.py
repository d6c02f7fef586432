"""Parts of the nodes that have a camera: calibration, motion prior, detections for other packages."""
