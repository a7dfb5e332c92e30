"""Identification of craters without a pose, kilometres off, and near a pose."""
