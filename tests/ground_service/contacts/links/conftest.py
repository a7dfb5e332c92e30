"""A ground station on two TCP ports that does what a test tells it."""

import contextlib
import socket
import threading
from dataclasses import dataclass, field

from pytest import fixture

from ground_service.contacts.links import core, runner, service
from ground_service.contacts.links.runner import LinkRunner
from ground_service.missions.service import add_mission

TIMEOUT_S = 900.0


@dataclass
class Station:
    """Telemetry port and telecommand port; `telecommands` is what was received on all connections."""

    down: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    up: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    telecommands: bytearray = field(default_factory=bytearray)
    connections: list[socket.socket] = field(default_factory=list)
    uplinks: list[socket.socket] = field(default_factory=list)

    def __post_init__(self):
        threading.Thread(target=self._take_uplinks, daemon=True).start()

    def accept(self, seconds=TIMEOUT_S):
        """Return the next telemetry connection of the service."""
        self.down.settimeout(seconds)
        connection, _ = self.down.accept()
        self.connections.append(connection)
        return connection

    def _take_uplinks(self):
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.up.accept()
                self.uplinks.append(connection)
                threading.Thread(target=self._read, args=(connection,), daemon=True).start()

    def _read(self, connection):
        with contextlib.suppress(OSError):
            while block := connection.recv(1 << 16):
                self.telecommands += block

    def link(self, extra=""):
        """Return the section of the mission description."""
        down, up = (one.getsockname()[1] for one in (self.down, self.up))
        return (
            f'[[links]]\nname = "lab"\nkind = "tcp"\ndownlink = "127.0.0.1:{down}"\n'
            f'uplink = "127.0.0.1:{up}"\nsilence_s = 60.0\n{extra}\n'
        )

    def close(self):
        """Close everything."""
        for one in self.down, self.up, *self.connections, *self.uplinks:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


WAITS = {"TICK_S": 0.05, "PAUSE_S": 0.1, "RETRY_S": 0.1, "MISSED_S": 0.1, "REFUSED_S": 0.1, "RENEW_S": 0.5}


@fixture(autouse=True)
def short_waits(monkeypatch):
    """Let links wait less than in operation, for events that the test causes."""
    for name, seconds in WAITS.items():
        monkeypatch.setattr(runner, name, seconds)


@fixture
def station(monkeypatch):
    """A station whose link soon comes back."""
    monkeypatch.setattr(core, "FIRST_WAIT_S", 0.05)
    made = Station()
    yield made
    made.close()


HEAD = 'name = "selenita"\n[spacecraft]\nid = 76\n'


def declare(ground, text):
    """Add a mission description with links."""
    add_mission(ground, (HEAD + text).encode(), actor="ann")


def acquired(ground, owner="here", name="lab", lease_ns=60 * 10**9):
    """Acquire a declared link; return its declaration."""
    declared = service.declared_links(ground)[name]
    assert service.acquire(ground, declared, owner, lease_ns)
    return declared


@contextlib.contextmanager
def operated(ground, owner="here"):
    """Operate the link "lab" in this process."""
    runner = LinkRunner(ground, acquired(ground, owner, lease_ns=15 * 10**9), owner)
    runner.start()
    try:
        yield runner
    finally:
        runner.stop()
