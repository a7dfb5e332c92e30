"""Scores of detectors: matching, metrics, intervals, reports."""
