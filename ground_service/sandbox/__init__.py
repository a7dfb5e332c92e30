"""Confinement of payload builds: programs of others, run without secrets, files or network of the service.

`kernel` holds the system calls, `launcher` is the process that sets a confined run up and watches it, `host` is the
side of the service: it describes a run, starts the launcher and checks what comes back.
"""
