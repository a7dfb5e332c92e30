"""Regression of payload builds against archived passes: archives, builds, gates, verdicts."""
