"""The true orbit and attitude, and what disturbs them."""
