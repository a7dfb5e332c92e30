"""Telecommands: entry, approval, release, hand-out, verification, receiver state."""
