"""Accuracy of navigation: errors against the reference, drift, baselines, consistency, smoother."""
