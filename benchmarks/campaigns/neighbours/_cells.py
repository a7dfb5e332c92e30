"""Cells of a row, as the environment of the other program records them: `SCRIPT.py FUNCTION SAMPLES OUT`."""

import json
import sys
import traceback
from pathlib import Path


class Cells:
    """Values that a program reads in our files (`samples`) and writes to files of its own (`out`)."""

    def __init__(self, samples, out):
        self.samples, self.out, self.entries = Path(samples), Path(out), []
        self.expected = json.loads((self.samples / "expected.json").read_text())

    def sample(self, name):
        return str(self.samples / name)

    def reads(self, what, expects, function, **more):
        """Record values of a file of ours; `expects` are the right ones, or their name."""
        self._record("reads", what, function, expects=expects, **more)

    def writes(self, what, file, reader, function, **more):
        """Record the values that `function(path)` writes; `reader` names what reads them on our side."""
        path = self.out / file
        self._record("writes", what, lambda: function(str(path)), file=str(path), reader=reader, **more)

    def packets(self, what, name, function):
        """Record the packets that a function writes, with a definition in XTCE of the same name."""
        self.writes(what, f"{name}.bin", "packets", function, xtce=[f"{name}.xml"])

    def not_tried(self, way, what, reason):
        self.entries.append({"way": way, "what": what, "not_tried": reason})

    def _record(self, way, what, function, **more):
        entry = {"way": way, "what": what, **more}
        try:
            entry["values"] = function()
        except BaseException as error:  # errors of Java and Rust are no Exception
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
