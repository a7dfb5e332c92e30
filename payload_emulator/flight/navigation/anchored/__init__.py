"""Anchored estimator: craters of the catalogue correct a dynamical orbit estimate."""
