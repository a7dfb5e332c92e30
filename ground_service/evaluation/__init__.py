"""Evaluation of a pass: alignment, drift, recall, smoothing, consistency, verdict, report."""
