"""Sections of the pass report: each function turns a view of the report into blocks."""
