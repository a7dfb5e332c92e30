"""On-board navigation: odometry, anchored filter, identification of craters, lost in space."""
