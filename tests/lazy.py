"""Heavy libraries of the tests, imported when a test first uses them."""

from importlib import import_module


class Lazy:
    """A module that is imported when one of its names is first used."""

    def __init__(self, module):
        self._module = module

    def __getattr__(self, name):
        if name.startswith("_"):  # asked of every name of a test module while tests are collected
            raise AttributeError(name)
        return getattr(import_module(self._module), name)


def expect(*subject):
    """Return the assertions of the driven browser about a page or a part of it."""
    return Lazy("playwright.sync_api").expect(*subject)
