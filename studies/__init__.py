"""Experiments on navigation and detection; their results are in docs/."""
