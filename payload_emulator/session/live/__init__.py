"""The spacecraft as a process: session, contacts, console, station ports, exact state, viewing."""
