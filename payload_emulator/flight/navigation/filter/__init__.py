"""The filter with its dynamics, attitude monitor and landmark map."""
