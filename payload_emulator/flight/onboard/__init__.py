"""On-board data handling: modes, schedule, telecommands, parameters, FDIR, housekeeping, observation."""
