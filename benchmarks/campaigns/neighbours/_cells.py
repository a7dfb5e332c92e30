"""Cells of one row of the table of compatibility, as the environment of the other program records them.

    python SCRIPT.py FUNCTION SAMPLES OUT

A function gets `Cells`. `reads` records what the program found in a file of ours, `writes` which values it wrote to a
file for us. The campaign compares both with the values of this project. One cell that fails does not stop the others.
"""

import json
import sys
import traceback
from pathlib import Path


class Cells:
    """Cells of a row: our files in `samples`, files of the program in `out`."""

    def __init__(self, samples, out):
        self.samples, self.out = Path(samples), Path(out)
        self.entries = []

    def sample(self, name):
        """Return the path of a file of ours."""
        return str(self.samples / name)

    def expected(self, name):
        """Return values of ours, for files that the program is to write."""
        return json.loads((self.samples / "expected.json").read_text())[name]

    def reads(self, what, expects, function, **more):
        """Record what the program reads in a file of ours; `expects` names the values that are right."""
        self._record("reads", what, function, expects=expects, **more)

    def writes(self, what, file, reader, function, **more):
        """Record the values that `function(path)` writes; `reader` names what reads them on our side."""
        path = self.out / file
        self._record("writes", what, lambda: function(str(path)), file=str(path), reader=reader, **more)

    def not_tried(self, way, what, reason):
        """Record why something was not tried."""
        self.entries.append({"way": way, "what": what, "not_tried": reason})

    def _record(self, way, what, function, **more):
        entry = {"way": way, "what": what, **more}
        try:
            entry["values"] = function()
        except BaseException as error:  # errors of Java and Rust are no Exception
            if isinstance(error, KeyboardInterrupt):
                raise
            traceback.print_exc()
            text = " ".join(str(error).split()) or "no message"
            entry["refused"] = f"{type(error).__name__.rpartition('.')[2]}: {text[:160]}"
        self.entries.append(entry)


def run(functions):
    """Run the function that the command line names and save its cells."""
    name, samples, out = sys.argv[1:]
    cells = Cells(samples, out)
    functions[name](cells)
    (cells.out / "cells.json").write_text(json.dumps(cells.entries))
