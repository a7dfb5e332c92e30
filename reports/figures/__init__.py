"""Drawings of report values. Every drawing function takes a `Canvas` and plain values, and returns nothing."""
