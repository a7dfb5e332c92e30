"""Packet definitions in XTCE: export of the dictionary, import and decoding of others."""
