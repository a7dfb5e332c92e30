"""Contacts with spacecraft: telecommands, and the links of the stations."""
