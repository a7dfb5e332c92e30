"""Commands as their users type them."""

import json

from pytest import fixture

from linna.cli import run


@fixture
def typed(capsys):
    """Run a command line that ends with a status; return its document or text, or the one line of its refusal."""

    def typed(line, status=0, *words):
        assert run([*line.split(), *map(str, words)]) == status
        out, err = capsys.readouterr()
        if status == 2:
            assert out == "" or "--json" in line
            (line,) = err.splitlines()
            return line
        return json.loads(out) if out[:1] in ("{", "[") else out

    return typed
