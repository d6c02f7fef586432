"""``aruco_detector``: markers of a frame, found, identified, refined, and the pose of each."""
