"""``tau2_camera``: clean counts from raw thermal frames."""
