"""Written and flown again: emulator, recording, mission description, replay, reconstruction, scoring, suite."""
