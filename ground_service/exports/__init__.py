"""Passes in the formats of other tools: ephemerides, attitudes, SPICE kernels, maps, tables and packets."""
