"""Front process: it accepts connections, answers `/healthz`, and passes all others to the server over a Unix socket.

The server computes in threads of one Python process, which can delay its event loop. The front process is separate, so
health checks are answered immediately at any load of the server. The response depends on the heartbeat of the server's
event loop: a server whose loop has stopped is not healthy.

Run as ``python -m ground_service.http.front LISTENER CHANNEL HEARTBEAT`` with the numbers of inherited descriptors. It
imports only the standard library, ignores signals and exits with the server.
"""

from __future__ import annotations

import contextlib
import mmap
import selectors
import signal
import socket
import struct
import sys
import time
from collections import OrderedDict, deque

HEALTH = b"GET /healthz"
HEARTBEAT = struct.Struct("d")
STALE_S = 30.0
SILENT_S = 1.0
"""Time after which a connection without a request is passed to the server."""

PEEKED_OCTETS = 16
ACCEPTED_AT_ONCE = 64
WAITING_LIMIT = 512
HANDED_LIMIT = 4096

OK = b'{"status":"ok"}'
BUSY = b'{"type":"about:blank","title":"busy","status":503,"detail":"the service does not respond"}'


class Front:
    """Connections that are neither answered nor passed on yet."""

    def __init__(self, listener: socket.socket, channel: socket.socket, heartbeat: mmap.mmap) -> None:
        self._listener, self._channel, self._heartbeat = listener, channel, heartbeat
        self._selector = selectors.DefaultSelector()
        self._waiting: OrderedDict[socket.socket, float] = OrderedDict()
        self._handed: deque[socket.socket] = deque()
        self._selector.register(listener, selectors.EVENT_READ)
        self._selector.register(channel, selectors.EVENT_READ)

    def run(self) -> None:
        """Serve until the server has ended."""
        while True:
            for key, events in self._selector.select(SILENT_S / 2 if self._waiting else None):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._channel:
                    if events & selectors.EVENT_READ and not self._server_listens():
                        self._finish()
                        return
                    if events & selectors.EVENT_WRITE:
                        self._hand_over()
                elif isinstance(key.fileobj, socket.socket):
                    self._look_at(key.fileobj)
            until = time.monotonic() - SILENT_S
            while self._waiting and next(iter(self._waiting.values())) < until:
                self._pass_on(next(iter(self._waiting)))

    def _finish(self) -> None:
        """Stop listening and pass on what was accepted, if the server stops; a server that has ended takes nothing."""
        self._accept(HANDED_LIMIT)
        self._listener.close()
        for client in list(self._waiting):
            self._pass_on(client)
        self._channel.settimeout(SILENT_S)
        with contextlib.suppress(OSError):
            for client in self._handed:
                socket.send_fds(self._channel, [b"c"], [client.fileno()])

    def _server_listens(self) -> bool:
        try:
            return bool(self._channel.recv(1))
        except BlockingIOError:
            return True
        except OSError:
            return False

    def _accept(self, limit: int = ACCEPTED_AT_ONCE) -> None:
        for _ in range(limit):
            try:
                client, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError:
                time.sleep(0.05)  # no descriptors are left; those already passed on are closed soon
                return
            client.setblocking(False)
            self._waiting[client] = time.monotonic()
            self._selector.register(client, selectors.EVENT_READ)
            self._look_at(client)
            if len(self._waiting) > WAITING_LIMIT:
                self._pass_on(next(iter(self._waiting)))

    def _look_at(self, client: socket.socket) -> None:
        try:
            begin = client.recv(PEEKED_OCTETS, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            begin = b""
        if not begin:
            self._forget(client)
            client.close()
        elif begin[: len(HEALTH) + 1] in (HEALTH + b" ", HEALTH + b"?"):
            self._forget(client)
            self._answer(client)
        else:
            # This includes an incomplete health check: the server answers it as well.
            self._pass_on(client)

    def _answer(self, client: socket.socket) -> None:
        (beat,) = HEARTBEAT.unpack_from(self._heartbeat)
        lives = time.monotonic() - beat < STALE_S
        body = OK if lives else BUSY
        head = (
            f"HTTP/1.1 {'200 OK' if lives else '503 Service Unavailable'}\r\n"
            f"content-type: application/{'' if lives else 'problem+'}json\r\n"
            f"cache-control: no-cache\r\nconnection: close\r\ncontent-length: {len(body)}\r\n\r\n"
        )
        with contextlib.suppress(OSError):
            client.recv(16_384)
            client.send(head.encode() + body)
            client.shutdown(socket.SHUT_WR)
        client.close()

    def _pass_on(self, client: socket.socket) -> None:
        self._forget(client)
        if len(self._handed) >= HANDED_LIMIT:
            client.close()
            return
        self._handed.append(client)
        self._hand_over()

    def _hand_over(self) -> None:
        """Pass on as many connections as the channel accepts now; keep the others for later."""
        while self._handed:
            try:
                socket.send_fds(self._channel, [b"c"], [self._handed[0].fileno()])
            except BlockingIOError:
                break
            except OSError:
                return  # the server has ended; the channel reports it next
            self._handed.popleft().close()
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._handed else 0)
        self._selector.modify(self._channel, events)

    def _forget(self, client: socket.socket) -> None:
        if self._waiting.pop(client, None) is not None:
            self._selector.unregister(client)


def main() -> None:
    listener = socket.socket(fileno=int(sys.argv[1]))
    channel = socket.socket(fileno=int(sys.argv[2]))
    heartbeat = mmap.mmap(int(sys.argv[3]), HEARTBEAT.size, access=mmap.ACCESS_READ)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    for one in (listener, channel):
        one.setblocking(False)
    Front(listener, channel, heartbeat).run()


if __name__ == "__main__":
    main()
