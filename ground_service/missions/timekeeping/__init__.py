"""On-board time: time reports, receptions, correlation."""
