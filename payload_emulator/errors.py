"""Errors of the payload emulator.

PayloadError
├── ScenarioError      a scenario file, or what it asks for, is not usable
├── TerrainError       a terrain source is missing, damaged or does not cover the place asked for
├── RendererError      a renderer is not installed, or cannot render the request
├── ModelError         a detector model is not the one that flight expects
├── ParameterError     a parameter file cannot be read
├── RecordError        an archived pass cannot be flown again
├── DatasetError       a data set is missing, incomplete or of another camera
├── DataProductError   a public data product cannot be fetched, or is damaged
└── LinkError          a port of the live payload cannot be opened
"""


def install_hint(extra: str) -> str:
    """Return how an optional part of the project is installed in this environment.

    A checkout has a Makefile; an environment without pip is served by another interpreter's pip.
    """
    import importlib.util
    import sys
    from pathlib import Path

    root = Path(__file__).resolve().parents[1]
    if (root / "Makefile").is_file() and (root / "pyproject.toml").is_file():
        return "make install-dev"
    pip = "pip" if importlib.util.find_spec("pip") else f"python3 -m pip --python {sys.executable}"
    return f"{pip} install 'linna[{extra}]'"


class PayloadError(Exception):
    """Base of every error that the payload emulator raises on purpose; the text is one line for a user."""


class ScenarioError(PayloadError):
    """A scenario cannot be flown: the message names the file, the key, what was expected and what was found."""


class TerrainError(PayloadError):
    """A terrain source is missing, damaged, or does not cover the place asked for."""


class RendererError(PayloadError):
    """Renderer that is not installed, failed, or cannot render the request."""


class ModelError(PayloadError):
    """A detector model has other inputs or outputs than flight expects, or fails its hash."""


class DatasetError(PayloadError):
    """A data set is missing, incomplete, or was made for another camera."""


class ParameterError(PayloadError):
    """A parameter file that is not valid TOML, or has an unknown parameter or an invalid value.

    `file`, `key`, `expected` and `found` are the parts of the message.
    """

    def __init__(self, file: str, key: str, expected: str, found: str) -> None:
        super().__init__(f"{file}{', ' if key else ''}{key}: expected {expected}, found {found}")
        self.file = file
        self.key = key
        self.expected = expected
        self.found = found


class RecordError(PayloadError):
    """An archived pass lacks what is needed to fly it again, or holds something else than was recorded."""


class LinkError(PayloadError):
    """A port of the live payload cannot be opened."""


class DataProductError(PayloadError):
    """A public data product cannot be fetched, or is not what its publisher says it is."""
