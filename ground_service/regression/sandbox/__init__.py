"""Sandbox for payload builds: third-party programs without access to secrets, files or the network of the service.

`host` starts bubblewrap, supervises a run and copies its outputs. `kernel` contains the system call filter.
"""
