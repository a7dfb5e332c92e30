"""The filter with its dynamics, attitude monitor and offset of the map."""
