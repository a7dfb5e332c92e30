"""One example for each command, and the page of the documentation that explains an error."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "ScenarioError": "tutorials/own-scenario",
    "TerrainError": "tutorials/own-terrain",
    "ModelError": "detector",
    "DatasetError": "detector",
    "ParameterError": "tutorials/own-build",
    "DatabaseNotMigrated": "deployment",
    "EphemerisError": "exports",
    "MissingLibrary": "exports",
    "mission": "mission",
    "ingest": "tutorials/other-packets",
    "regress": "tutorials/own-build",
    "plan": "planning",
    "command": "commanding",
}
"""Page of an error by its class; for invalid input, by the command."""
_OF_COMMAND = {"InvalidInput", "InvalidRequest", "JobFailed"}


def example(command: str) -> str:
    """Return the first example line of a command and those below it."""
    lines = Path(__file__).with_name("examples.txt").read_text(encoding="utf-8").splitlines()
    return next((line for line in lines if f"{line} ".startswith(f"{command} ")), "")


def help_page(error: BaseException, command: str) -> str:
    """Return the file of the page that explains an error, as built, else its source; empty if there is none."""
    names = [one.__name__ for one in type(error).__mro__]
    keys = [command] if _OF_COMMAND & {*names} else names
    found = next((PAGES[key] for key in keys if key in PAGES), "")
    files = (ROOT / f"ground_service/web/help/{found}.html", ROOT / f"docs/{found}.md")
    return next((str(file) for file in files if found and file.is_file()), "")
