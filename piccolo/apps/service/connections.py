"""Connections of the service: a connection without progress is closed, and their number is limited.

Uvicorn has no time-out for headers, bodies and slow readers. Its limit of connections refuses new ones while
silent ones stay, and its log repeats the same message for each.
"""

import asyncio
import json
import logging
import socket
from collections import deque
from time import monotonic
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...system.jobs.memory import allow_files

STALL_S = 20.0  # [s] for the headers of a request, and for each step of its body
BODY_STEP = 1 << 14  # [byte] of a body that count as progress
LOOK_S = 1.0  # [s] between checks whether a connection has stalled, at least
BACKLOG = 32  # connections accepted before the first of them is counted
FILES = 64 + BACKLOG  # files that are open besides those of jobs and connections
FILES_OF_JOB = 8  # pipes to its process, and files that are sent to it
FILES_OF_CONNECTION = 2  # its socket, and the photo that it sends
MAX_CONNECTIONS = 500
MIN_CONNECTIONS = 8
LINES = 3  # of one kind that are written to the log in the time
WITHIN_S = 60.0  # [s]
ERROR = json.dumps({"error": f"found no more of the request for {STALL_S:g} s, wanted all of it"}).encode()
LATE = (
    b"HTTP/1.1 408 Request Timeout\r\nContent-Type: application/json\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(ERROR), ERROR)
)


class Connection(H11Protocol):
    """A connection that is closed if it stalls, or, of too many, if it is the longest without progress."""

    progress_s = 0.0  # [s] time of its last progress
    num_bytes = 0  # received since then
    is_full = False  # the client does not read what was sent
    look_later: asyncio.TimerHandle | None = None

    @property
    def is_awaited(self) -> bool:
        """True if the service waits for the client to send or to read."""
        cycle = self.cycle
        return self.is_full or cycle is None or cycle.response_complete or cycle.more_body

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection; if there are too many, close the one that is longest without progress."""
        super().connection_made(transport)
        self.get_on()
        self.look()
        others = [c for c in self.connections if isinstance(c, Connection) and not c.transport.is_closing()]
        if len(others) > (self.limit_concurrency or 0) - BACKLOG:  # uvicorn refuses requests at its own limit
            min((c for c in others if c.is_awaited), key=lambda c: c.progress_s).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the checks of a connection that is closed."""
        super().connection_lost(exc)
        if self.look_later:
            self.look_later.cancel()

    def data_received(self, data: bytes) -> None:
        """Receive data; whole headers, BODY_STEP bytes of a body and the body's end count as progress."""
        before = self.cycle
        super().data_received(data)
        self.num_bytes += len(data)
        is_step = self.num_bytes >= BODY_STEP and self.cycle is not None
        if is_step or self.cycle is not before or not self.is_awaited:
            self.get_on()

    def on_response_complete(self) -> None:
        """Begin to wait for the next request, or for the rest of a body that was refused."""
        super().on_response_complete()
        self.get_on()

    def pause_writing(self) -> None:
        """Begin to wait for the client to read."""
        super().pause_writing()
        self.is_full = True
        self.get_on()

    def resume_writing(self) -> None:
        """Note that the client reads again."""
        super().resume_writing()
        self.is_full = False
        self.get_on()

    def get_on(self) -> None:
        """Note progress: the time-out begins again."""
        self.progress_s = self.loop.time()
        self.num_bytes = 0

    def look(self) -> None:
        """Close the connection if it has stalled, else check again later."""
        left_s = self.progress_s + STALL_S - self.loop.time()
        if self.is_awaited and left_s <= 0.0:
            self.give_up()
        else:
            self.look_later = self.loop.call_later(max(left_s, LOOK_S), self.look)

    def give_up(self) -> None:
        """Close the connection; if a request was received in part, answer 408 first."""
        if self.is_full:
            self.transport.abort()
            return
        if self.cycle is not None and self.cycle.more_body and not self.cycle.response_started:
            self.transport.write(LATE)
        self.transport.close()


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket whose connections send without delay (TCP_NODELAY)."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    server = socket.create_server((host, port), family=family)
    # asyncio sets the option only for sockets that name their protocol, which create_server's do not
    server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return server


def most_connections(num_jobs: int) -> int:
    """Return the number of connections that the system's limit of open files allows."""
    num_files = allow_files(FILES + FILES_OF_JOB * num_jobs + FILES_OF_CONNECTION * MAX_CONNECTIONS)
    room = num_files - FILES - FILES_OF_JOB * num_jobs
    return max(room // FILES_OF_CONNECTION, MIN_CONNECTIONS)


class Throttle(logging.Filter):
    """A filter that passes a few lines of a kind in a minute; errors of the system get no traceback."""

    def __init__(self) -> None:
        super().__init__()
        self.times: dict[Any, deque[float]] = {}  # [s] of the last lines, by kind

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True for a line that is to be written."""
        now_s = monotonic()
        times = self.times.setdefault((record.name, record.msg), deque(maxlen=LINES))
        if len(times) == LINES and now_s - times[0] < WITHIN_S:
            return False
        times.append(now_s)
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, OSError | MemoryError):
            record.msg = f"{record.getMessage().splitlines()[0]}: {error or 'no memory'}"
            record.args = None
            record.exc_info = None
        return True


def configure(app: ASGIApp, num_jobs: int, grace_s: float) -> uvicorn.Config:
    """Return the configuration with which uvicorn runs an application; logs go to stderr, throttled."""
    logging.getLogger("piccolo").handlers.clear()  # a command's handler writes each message only once
    handler = logging.StreamHandler()
    handler.addFilter(Throttle())
    logging.basicConfig(handlers=[handler], format="%(message)s", level=logging.WARNING)
    return uvicorn.Config(
        app,
        http=Connection,
        limit_concurrency=most_connections(num_jobs) + BACKLOG,
        backlog=BACKLOG,
        timeout_keep_alive=int(STALL_S),
        timeout_graceful_shutdown=int(grace_s),
        log_config=None,
        log_level=logging.WARNING,
        access_log=False,
        server_header=False,
    )
