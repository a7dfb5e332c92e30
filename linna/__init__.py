"""The `linna` command line: the only package that knows both the payload emulator and the ground service."""

__version__ = "0.1.0"
