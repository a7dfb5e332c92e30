"""Frozen values in; figures, HTML, PDF and JSON out. Knows no database, no packets and no payload."""
