"""Errors of the command line itself."""


class UsageError(Exception):
    """The command line asks for something that cannot be done; the text is one line for the user."""
