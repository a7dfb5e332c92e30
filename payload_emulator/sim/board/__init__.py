"""The simulated board and its link: clock, sensors, memory, faults, losses."""
