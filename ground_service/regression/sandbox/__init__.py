"""Sandbox for payload builds: third-party programs without access to secrets, files or the network of the service.

`kernel` contains the system calls. `launcher` is the process that sets up and supervises a run. `host` is the interface
of the service: it describes a run, starts the launcher and validates the result.
"""
