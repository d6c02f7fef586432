"""Maps off the robot: built from photos and recordings, edited, doubted, laid into point clouds."""
