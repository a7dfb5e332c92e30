"""The paper's visual odometry and the spherical one."""
