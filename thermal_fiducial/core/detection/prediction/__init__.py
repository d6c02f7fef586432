"""What is known of a frame before its image is used: the camera's motion, the blur it makes, and where markers are."""
