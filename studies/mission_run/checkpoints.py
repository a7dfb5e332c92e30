"""Checkpoints of a mission run: spacecraft, archive and progress of one moment at which the ground is idle."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

SPACECRAFT, ARCHIVE, PROGRESS = "spacecraft", "archive.db", "progress.json"


@dataclass(frozen=True, slots=True)
class Checkpoints:
    """The newest checkpoint in the folder of a run.

    Attributes
    ----------
    folder
        Folder of the run.
    home
        Folder of the ground service with its SQLite database; None: the archive of a server is not put back, since
        it may be ahead of the spacecraft, which repeats what it did.
    state
        File of the exact state of the spacecraft.
    """

    folder: Path
    home: Path | None
    state: Path

    def keep(self, progress: Path) -> None:
        """Make a checkpoint of the present files in place of the one before.

        Files of the archive are named by their content and never change, so its database is enough.
        """
        new = self.folder / "checkpoint.new"
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(mode=0o700)
        shutil.copyfile(self.state, new / SPACECRAFT)
        shutil.copyfile(progress, new / PROGRESS)
        if self.home is not None:
            self._keep_archive(self.home, new / ARCHIVE)
        old = self.folder / "checkpoint.old"
        shutil.rmtree(old, ignore_errors=True)
        if self._place.exists():
            self._place.rename(old)
        new.rename(self._place)
        shutil.rmtree(old, ignore_errors=True)

    @staticmethod
    def _keep_archive(home: Path, path: Path) -> None:
        with closing(sqlite3.connect(home / "linna.db")) as source, closing(sqlite3.connect(path)) as target:
            source.backup(target)

    def restore(self) -> Path | None:
        """Put spacecraft and archive back to the newest checkpoint, or to nothing without one; return its progress."""
        found = next((one for one in (self._place, self.folder / "checkpoint.old") if one.exists()), None)
        self.state.unlink(missing_ok=True)
        if self.home is not None:
            shutil.rmtree(self.home / "incoming", ignore_errors=True)
            for suffix in ("", "-wal", "-shm"):
                (self.home / f"linna.db{suffix}").unlink(missing_ok=True)
            if found is None:
                shutil.rmtree(self.home, ignore_errors=True)
            else:
                shutil.copyfile(found / ARCHIVE, self.home / "linna.db")
        if found is None:
            return None
        shutil.copyfile(found / SPACECRAFT, self.state)
        return found / PROGRESS

    @property
    def _place(self) -> Path:
        return self.folder / "checkpoint"
