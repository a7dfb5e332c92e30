"""Operation of one link: receive, spool, ingest, follow contacts, and send released telecommands.

Two threads. One receives into a spool on disk, follows the contacts and sends; the other ingests the spool. Received
octets are on disk before they are acknowledged, and a full spool stops reading, so that the flow control of TCP holds
the station back. What an ended process has left in the spool is ingested by the next owner.
"""

import contextlib
import fcntl
import logging
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from ground_service.clock import mission_now_ns
from ground_service.contacts.links import core, service, store
from ground_service.contacts.links.core import next_wait_s
from ground_service.contacts.links.service import DeclaredLink
from ground_service.contacts.links.store import ContactRow, TransmissionRow
from ground_service.errors import PASSING, GroundError, StorageFull, StorageReadOnly, storage_error
from ground_service.ground import Ground
from ground_service.ingest.live import SEGMENT_OCTETS, Spool, WatchedFolder
from ground_service.ingest.model import IngestResult
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.store.files import make_durable_folder, replace_durably

CONNECT_S = 3.0
SEND_S = 4.0
BLOCK_OCTETS = 1 << 16
NOT_YET = "not connected yet"
DISCARDED_BLOCKS = 64
"""Limit for one call: a station that sends on the uplink without end must not stop the link."""

CONFIRM_S = 4.0
ACKNOWLEDGEMENT = struct.Struct(">Q")
TRANSMISSION = struct.Struct(">QI")
"""Header of telecommand octets for a station that confirms: number of the transmission, number of octets."""

REFUSED = 0
"""Answer of a station that cannot send the transmission now."""


@dataclass(slots=True)
class Connector:
    """A TCP connection that is opened again, with growing waits, after it was lost.

    Attributes
    ----------
    fault
        Why there is no connection; None while it is open.
    """

    address: tuple[str, int]
    reconnect: bool = True
    fault: str | None = NOT_YET
    over: bool = False
    _socket: socket.socket | None = None
    _wait_s: float = 0.0
    _next_s: float = field(default=0.0)

    @property
    def connected(self) -> bool:
        """Return whether the connection is open."""
        return self._socket is not None

    def connect(self) -> bool:
        """Open the connection if it is time for an attempt; return whether it is open."""
        if self._socket is not None:
            return True
        if self.over or time.monotonic() < self._next_s:
            return False
        try:
            self._socket = socket.create_connection(self.address, timeout=CONNECT_S)
        except OSError as error:
            self._lost(error.strerror or str(error))
            return False
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.fault = None
        return True

    def receive(self, timeout_s: float) -> bytes | None:
        """Return received octets; None if nothing came within the time, or the connection was lost."""
        if self._socket is None:
            return None
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return None
            octets = self._socket.recv(BLOCK_OCTETS)
        except (OSError, ValueError) as error:
            self._lost(str(error))
            return None
        if not octets:
            self._lost("closed by the station")
            self.over = not self.reconnect
            return None
        self._wait_s = 0.0
        return octets

    def send(self, octets: bytes) -> bool:
        """Send octets completely; return whether that succeeded."""
        if self._socket is None:
            return False
        try:
            self._socket.settimeout(SEND_S)
            self._socket.sendall(octets)
        except OSError as error:
            self._lost(str(error))
            return False
        self._wait_s = 0.0
        return True

    def confirmed(self, number: int) -> bool:
        """Return whether the station confirms a transmission, and not that it cannot send it now."""
        answer, until = b"", time.monotonic() + CONFIRM_S
        while len(answer) < ACKNOWLEDGEMENT.size:
            left = until - time.monotonic()
            octets = self.receive(left) if left > 0.0 else None
            if octets is None:
                if self.connected:
                    self._lost("no confirmation of a transmission")
                return False
            answer += octets
        (found,) = ACKNOWLEDGEMENT.unpack(answer[: ACKNOWLEDGEMENT.size])
        if found not in (number, REFUSED) or len(answer) > ACKNOWLEDGEMENT.size:
            self._lost(f"expected the confirmation of transmission {number}, found {answer[:16].hex()}")
        return bool(found == number)

    def discard_input(self) -> bool:
        """Read what the other side sends without use; return whether the connection is still open."""
        for _ in range(DISCARDED_BLOCKS):
            if self.receive(0.0) is None:
                break
        return self.connected

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _lost(self, reason: str) -> None:
        self.close()
        self._wait_s = next_wait_s(self._wait_s)
        self._next_s = time.monotonic() + self._wait_s
        self.fault = reason


def address_of(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``."""
    host, _, port = text.rpartition(":")
    return host.strip("[]"), int(port)


log = logging.getLogger(__name__)

LEASE_NS = 15_000_000_000
"""Longer than the renewal interval and all waits of one step: connecting, sending."""

RENEW_S = 3.0
TICK_S = 0.1
POLL_S = 0.05
"""A station that pauses for this long has sent what it has: the segment is ingested."""

WHOLE_S = 0.01
"""A station that pauses for this long after a whole frame has sent what it has, if the frames before were whole."""

PAUSE_S = 0.5
"""After this long, octets are ingested even if others are being ingested."""

SPOOL_LIMIT_OCTETS = 256 << 20
RETRY_S = 1.0
REFUSED_S = 0.5
"""Time after which a station that has refused a transmission is asked again."""

TURN_S = 30.0
"""Longest time for which telecommands wait for earlier ones of another link."""

MISSED_S = 1.0
INCOMING = "incoming"
LOCK = "lock"
"""File in the folder of the spool with the name of the owner that holds it."""

OWNER_LIMIT = 200


@dataclass(slots=True)
class _Progress:
    """Octets of the link in this process: received, and of these ingested.

    `heard_utc_ns` is the mission time of the newest reception, `empty_utc_ns` the one before the newest look at the
    connection that found nothing. Octets that wait unread are no silence, however late they are read. `frame_octets` is
    the length of a frame, with its record, of the segment that was ingested last; 0 if it did not end with a frame.
    `ends_whole`: nothing waits for octets behind that segment.
    """

    received: int = 0
    ingested: int = 0
    frame_octets: int = 0
    ends_whole: bool = False
    heard_utc_ns: int | None = None
    empty_utc_ns: int | None = None
    cut_utc_ns: dict[str, int] = field(default_factory=dict)


class LinkRunner:
    """A link that this process owns; `start` and `stop` may be called once each."""

    def __init__(self, ground: Ground, declared: DeclaredLink, owner: str) -> None:
        self.declared = declared
        self._ground, self._owner = ground, owner
        self._name = declared.link.name
        self._stopping, self._work = threading.Event(), threading.Event()
        self._cut_all = threading.Event()
        self._threads: list[threading.Thread] = []
        self._progress = _Progress()
        self._folder = ground.home / INCOMING / f"link-{self._name}"
        self._spool = Spool(self._folder, self._ingest_segment, self._report)
        self._down = self._connector(declared.link.downlink)
        self._up = self._connector(declared.link.uplink)
        self._lock: TextIO | None = None
        self._opened = False
        self._block: bytes | None = None
        self._contact: ContactRow | None = None
        self._shown: tuple[str, str | None] | None = None
        self._ingest_fault: str | None = None
        self._remark = ""
        self._renewed_s = self._missed_s = self._sent_s = self._refused_until_s = 0.0
        self._acknowledged = 0
        self._last_block_s = 0.0
        self._repeated_for: int | None = None
        self._waits_s: float | None = None
        self._overtaking: int | None = None
        self.lost = False

    @property
    def octets_received(self) -> int:
        """Octets that were received and ingested since the start, with those that an earlier owner had left."""
        return self._progress.ingested

    @property
    def alive(self) -> bool:
        """Return whether the link is operated: started, not stopped, and owned."""
        return bool(self._threads) and all(one.is_alive() for one in self._threads)

    def start(self) -> None:
        """Operate the link in threads of this process, which has its lease."""
        runs = (self._operate, self._ingest_all)
        self._threads = [threading.Thread(target=run, name=f"link {self._name}", daemon=True) for run in runs]
        for thread in reversed(self._threads):  # the first joins the second
            thread.start()

    def stop(self) -> None:
        """End the threads after the current segment is ingested, and give the link back."""
        self._stopping.set()
        self._work.set()
        for thread in self._threads:
            thread.join()
        for one in (self._down, self._up):
            if one is not None:
                one.close()
        if not self.lost:
            with contextlib.suppress(GroundError):
                service.release(self._ground, self._name, self._owner)

    # Receiving, contacts and sending

    def _operate(self) -> None:
        try:
            while not self._stopping.is_set() and not self.lost:
                self._guarded(self._step if self._opened else self._open)
            with contextlib.suppress(GroundError, OSError):
                if self._block is not None:
                    self._keep(self._block)
                self._cut()
        finally:
            # The ingest ends before another process can hold the spool: one process at a time removes segments.
            self._cut_all.set()
            self._work.set()
            self._threads[1].join()
            if self._lock is not None:
                with contextlib.suppress(OSError):
                    self._lock.truncate(0)
                self._lock.close()

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do one step; faults of the database or the disk are shown and the step is repeated later."""
        try:
            work()
        except PASSING as error:
            log.warning("link %s: %s", self._name, error)
            if isinstance(error, StorageFull | StorageReadOnly):
                self._show_failed(error)
            else:
                self._shown = None
            self._stopping.wait(RETRY_S)
        except (GroundError, OSError) as error:
            log.warning("link %s: %s", self._name, error)
            self._show_failed(error)
            self._stopping.wait(RETRY_S)

    def _open(self) -> None:
        if not self._keep_lease():
            return
        if not self._hold_spool():
            self._show("waiting", "another process holds the spool of the link")
            self._stopping.wait(RETRY_S)
            return
        left = self._spool.open()
        self._progress.received = self._progress.ingested + left
        self._contact = self._ground.read(store.open_contact, self._name)
        if self._contact is not None:
            # When octets in the spool were received is not known: now at the latest.
            received_ns = None if left else service.last_reception_ns(self._ground, self._name)
            self._progress.heard_utc_ns = (
                max(self._contact.start_utc_ns, received_ns or 0) if received_ns else mission_now_ns()
            )
        self._opened = True
        self._work.set()

    def _step(self) -> None:
        if not self._keep_lease():
            return
        if self.declared.link.kind == "file":
            self._step_file()
            return
        self._receive()
        self._follow_contact()
        self._send()
        self._show_state()

    def _receive(self) -> None:
        if self._down is None:
            self._stopping.wait(TICK_S)
            return
        if self._block is None:
            if not self._down.connected:
                self._acknowledged = 0
            before = mission_now_ns()
            if not self._down.connect():
                self._progress.empty_utc_ns = before
                self._stopping.wait(TICK_S)
                return
            if self._progress.received - self._progress.ingested >= SPOOL_LIMIT_OCTETS:
                self._stopping.wait(TICK_S)  # the flow control of TCP holds the station back
                return
            self._block = self._down.receive(WHOLE_S if self._holds_whole_frames else POLL_S)
            if self._block is None:
                self._progress.empty_utc_ns = before
        octets = self._block
        if octets is None:
            is_over = time.monotonic() - self._last_block_s >= PAUSE_S or not self._down.connected
            if self._ingest_is_idle or is_over:
                self._cut()
            return
        self._last_block_s = time.monotonic()
        self._hear()
        self._keep(octets)
        if self.declared.link.acknowledge:
            self._acknowledged += len(octets)
            self._down.send(ACKNOWLEDGEMENT.pack(self._acknowledged))
        if self._spool.size >= SEGMENT_OCTETS:
            self._cut()

    @property
    def _holds_whole_frames(self) -> bool:
        """Return whether the segment ends with a frame, by the length of the frames before it."""
        frame = self._progress.frame_octets
        return bool(frame and self._spool.size and self._spool.size % frame == 0)

    @property
    def _ingest_is_idle(self) -> bool:
        return self._progress.received - self._spool.size <= self._progress.ingested

    def _keep(self, octets: bytes) -> None:
        """Write the received block to the spool; after an error it stays in `_block` for the next attempt."""
        self._spool.keep(octets, durably=self.declared.link.acknowledge)
        self._block = None
        self._progress.received += len(octets)

    def _hear(self) -> None:
        """Note a reception now; after a silence it starts a new contact."""
        now = mission_now_ns()
        received_ns = self._progress.heard_utc_ns
        if self._contact is not None and received_ns is not None and self._was_silent_since(received_ns):
            self._cut()
            self._finish_contact(received_ns, wait=True)
        if self._contact is None:
            if self._progress.ends_whole:  # else the next octets may belong to the frame that was cut
                self._spool.begin()
            self._contact = service.start_contact(self._ground, self.declared, now)
        self._progress.heard_utc_ns = now
        # Only a later look can find a silence; mission time may have been set back since the last one.
        self._progress.empty_utc_ns = None

    def _follow_contact(self) -> None:
        now, received_ns = mission_now_ns(), self._progress.heard_utc_ns
        if self._contact is not None and received_ns is not None and self._was_silent_since(received_ns):
            self._cut()
            self._finish_contact(received_ns, wait=False)
        if time.monotonic() - self._missed_s >= MISSED_S and self._contact is None:
            self._missed_s = time.monotonic()
            fault = self._down.fault if self._down is not None else None
            why = "nothing was received" if fault is None else f"no connection: {fault}"
            service.note_missed(self._ground, self.declared, self._owner, now, why)

    def _finish_contact(self, stop_utc_ns: int, *, wait: bool) -> None:
        """End the contact when everything that was received in it is ingested."""
        while wait and self._progress.ingested < self._progress.received and not self._stopping.wait(POLL_S):
            if not self._keep_lease():
                return
        if self._contact is None or self._progress.ingested < self._progress.received:
            return
        service.end_contact(self._ground, self._contact.id, self._name, stop_utc_ns)
        self._contact = None

    @property
    def _silence_s(self) -> float:
        return self.declared.link.silence_s

    def _was_silent_since(self, received_ns: int) -> bool:
        empty = self._progress.empty_utc_ns
        return empty is not None and core.is_silent(received_ns, empty, self._silence_s)

    def _send(self) -> None:
        if self._up is None:
            return
        if time.monotonic() - self._sent_s < TICK_S:
            return
        self._sent_s = time.monotonic()
        due = service.send_due(self._ground, self._name)
        automatic = self.declared.link.send == "automatic" and self._contact is not None
        may_take = automatic or due.requested
        # A station that confirms can say at any time whether it has sent a transmission.
        if not (may_take or (due.pending and self.declared.link.confirm)):
            return
        if time.monotonic() < self._refused_until_s or not self._up.connect() or not self._up.discard_input():
            return
        if self._contact is not None and self._repeated_for != self._contact.id and self._progress.ingested:
            service.repeat_unconfirmed(self._ground, self.declared, self._contact)
            self._repeated_for = self._contact.id
        transmissions = (
            service.take_transmissions(self._ground, self.declared, self._owner)
            if may_take
            else self._ground.read(store.pending_transmissions, self._name)
        )
        for one in transmissions:
            if not self._is_in_turn(one):
                return
            if self._transmit(self._up, one):
                self._note_transmitted(one)
            elif not self._is_handed_over(self._up, one):
                return
        if due.requested:
            self._ground.write(store.change_link, self._name, self._owner, send_done=due.request)

    def _is_in_turn(self, transmission: TransmissionRow) -> bool:
        """Return whether no earlier transmission of the spacecraft waits at another link, or the wait was too long.

        The payload refuses telecommands that overtake others.
        """
        others = self._ground.read(store.links_with_earlier, transmission)
        now = time.monotonic()
        if not others:
            self._waits_s = None
            return True
        if self._waits_s is None:
            self._waits_s = now
        if now - self._waits_s < TURN_S:
            return False
        if transmission.id != self._overtaking:
            self._overtaking = transmission.id
            log.warning(
                "link %s: telecommands %s are sent before earlier ones of link %s",
                self._name,
                list(transmission.telecommands),
                ", ".join(others),
            )
        return True

    def _is_handed_over(self, up: Connector, transmission: TransmissionRow) -> bool:
        """Give a transmission that the station has refused to the link in contact; return whether there is one.

        A contact ends for this link after a silence only: until then it can take telecommands that another station
        has to send.
        """
        if not (self.declared.link.confirm and up.connected):
            return False  # the station did not refuse it, and may have sent it
        other = service.hand_over(self._ground, self.declared, transmission)
        if other is None:
            self._refused_until_s = time.monotonic() + REFUSED_S
            return False
        log.info("link %s: telecommands %s given to link %s", self._name, list(transmission.telecommands), other)
        return True

    def _transmit(self, up: Connector, transmission: TransmissionRow) -> bool:
        """Send a transmission; return whether it is on the wire, or at a station that confirms it.

        A transmission whose confirmation was not recorded is sent again with the same number, and a station sends no
        number up twice.
        """
        if not self.declared.link.confirm:
            return up.send(transmission.octets)
        number = transmission.id << 8 | transmission.attempts
        head = TRANSMISSION.pack(number, len(transmission.octets))
        return up.send(head + transmission.octets) and up.confirmed(number)

    def _note_transmitted(self, transmission: TransmissionRow) -> None:
        contact = None if self._contact is None else self._contact.id
        service.note_transmitted(self._ground, transmission, contact)
        log.info("link %s: telecommands %s sent", self._name, list(transmission.telecommands))

    def _cut(self) -> None:
        now = mission_now_ns()
        sealed = self._spool.cut()
        if sealed is not None:
            self._progress.cut_utc_ns[sealed.name] = self._progress.heard_utc_ns or now
            self._work.set()

    # Folders

    def _step_file(self) -> None:
        link = self.declared.link
        missing = [one for one in (link.downlink, link.uplink) if one is not None and not Path(one).is_dir()]
        if missing:
            self._show("waiting", f"{missing[0]}: expected a folder, found nothing")
            self._stopping.wait(RETRY_S)
            return
        if link.downlink is not None:
            ledger = self._folder / "ingested.json"
            folder = WatchedFolder(Path(link.downlink), ledger, self._ingest_of_folder, self._report)
            folder.look(time.time())
            if self._contact is not None:
                service.end_contact(self._ground, self._contact.id, self._name, mission_now_ns())
                self._contact = None
        if link.uplink is not None:
            due = service.send_due(self._ground, self._name)
            if link.send == "automatic" or due.requested:
                for one in service.take_transmissions(self._ground, self.declared, self._owner):
                    _write_transmission(Path(link.uplink), one, link.format)
                    self._note_transmitted(one)
                if due.requested:
                    self._ground.write(store.change_link, self._name, self._owner, send_done=due.request)
        self._show("connected", self._ingest_fault)
        self._stopping.wait(TICK_S * 5)

    def _ingest_of_folder(self, path: Path) -> dict[str, Any]:
        if self._contact is None:
            self._contact = service.start_contact(self._ground, self.declared, mission_now_ns())
        self._progress.received += path.stat().st_size
        self._progress.cut_utc_ns[path.name] = mission_now_ns()
        return self._ingest(path)

    # Ingest

    def _ingest_all(self) -> None:
        while True:
            self._work.wait()
            self._work.clear()
            over = self._cut_all.is_set()
            try:
                if self._lock is not None:  # without it another process removes the segments
                    self._spool.drain()
                self._ingest_fault = None
            except PASSING as error:
                self._retry(error)
            except Exception as error:  # outermost loop of the thread: the segment stays in the spool
                log.exception("link %s: ingest", self._name)
                self._retry(error)
            if over:
                return

    def _retry(self, error: Exception) -> None:
        self._ingest_fault = f"ingest waits: {error}"
        log.warning("link %s: %s", self._name, self._ingest_fault)
        if not self._stopping.wait(RETRY_S):
            self._work.set()

    def _ingest_segment(self, path: Path, recording: str, offset: int) -> dict[str, Any]:
        return self._ingest(path, PiecePosition(f"{self._name} {recording}", offset))

    def _ingest(self, path: Path, place: PiecePosition | None = None) -> dict[str, Any]:
        link = self.declared.link
        made = ingest_file(
            self._ground,
            path,
            spacecraft_id=self.declared.spacecraft_id,
            instance=link.instance,
            name=f"{self._name} {path.name}",
            place=place,
            station=link.station or "",
        )
        return {"result": made}

    def _report(self, path: Path, result: dict[str, Any] | GroundError) -> None:
        octets = path.stat().st_size if path.is_file() else 0
        received_ns = self._progress.cut_utc_ns.pop(path.name, None)
        made = result["result"] if isinstance(result, dict) else None
        if isinstance(result, GroundError):
            log.warning("link %s: %s: %s", self._name, path.name, result)
        contact = self._contact
        service.note_reception(
            self._ground,
            self._name,
            None if contact is None else contact.id,
            octets,
            received_ns,
            _clock_offset_ns(made, received_ns),
        )
        self._remark = "" if made is None else made.remark
        self._progress.frame_octets = _frame_octets(made)
        self._progress.ends_whole = made is not None and made.octets_pending == 0
        self._progress.ingested += octets

    # State

    def _keep_lease(self) -> bool:
        since = time.monotonic() - self._renewed_s
        if since < RENEW_S:
            return True
        if not service.acquire(self._ground, self.declared, self._owner, LEASE_NS):
            log.warning("link %s: another process has taken it over", self._name)
            self.lost = True
            self._stopping.set()
            self._work.set()
            return False
        if since * 1e9 > LEASE_NS:
            self._shown = None  # another process may have changed what is stored
        self._renewed_s = time.monotonic()
        return True

    def _show_state(self) -> None:
        down = self._down
        if down is not None and not down.connected:
            state, reason = ("failed" if down.over else "waiting"), down.fault
        elif self._contact is not None:
            state, reason = "contact", None
        else:
            state, reason = "connected", None
        if self._up is not None and self._up.fault and self._up.fault != NOT_YET:
            reason = f"{reason + '; ' if reason else ''}uplink: {self._up.fault}"
        if fault := self._ingest_fault or self._remark:
            reason = f"{reason + '; ' if reason else ''}{fault}"
        self._show(state, reason)

    def _show(self, state: str, reason: str | None) -> None:
        if self._shown == (state, reason):
            return
        if service.change_state(self._ground, self._name, self._owner, state, reason):
            self._shown = (state, reason)

    def _show_failed(self, error: Exception) -> None:
        with contextlib.suppress(GroundError):
            self._show("failed", str(error))

    def _connector(self, address: str | None) -> Connector | None:
        if address is None or self.declared.link.kind != "tcp":
            return None
        return Connector(address_of(address), self.declared.link.reconnect)

    def _hold_spool(self) -> bool:
        """Take the lock file of the spool; return whether this process holds it."""
        if self._lock is not None:
            return True
        try:
            make_durable_folder(self._folder)
            file = (self._folder / LOCK).open("a")
        except OSError as error:
            raise storage_error(error, self._folder) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            return False
        with contextlib.suppress(OSError):  # without the name, others wait for the end of the lease
            file.truncate(0)
            file.write(self._owner)
            file.flush()
        self._lock = file
        return True


def ended_holder(home: Path, name: str) -> str | None:
    """Return the owner that held the spool of a link and has ended without giving it back; None if not known.

    The kernel ends the lock of a process with the process, so that nobody need wait for the end of its lease.
    """
    with contextlib.suppress(OSError), (home / INCOMING / f"link-{name}" / LOCK).open() as file:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return file.read(OWNER_LIMIT) or None
    return None


def _frame_octets(made: IngestResult | None) -> int:
    """Return the octets of each frame, with its record, of a piece that ends with a frame; 0 for any other piece."""
    reception = None if made is None or made.octets_pending else made.reception
    if reception is None or not reception.frames:
        return 0
    return (reception.octets_frames + reception.octets_records) // reception.frames


def _clock_offset_ns(made: IngestResult | None, heard_utc_ns: int | None) -> int | None:
    """Return the last reception time in the records of the station minus the mission time of the reception."""
    reception = None if made is None else made.reception
    last = None if reception is None else reception.last_utc_ns
    return None if last is None or heard_utc_ns is None else last - heard_utc_ns


def _write_transmission(folder: Path, transmission: TransmissionRow, form: str) -> None:
    """Write the octets of a transmission as a file; a repeated call replaces it."""
    target = folder / f"{transmission.link}-{transmission.id:08d}.{form}"
    temporary = target.with_suffix(".part")
    try:
        temporary.write_bytes(transmission.octets)
        replace_durably(temporary, target)
    except OSError as error:
        raise storage_error(error, folder) from None
