"""Connections of the service that say nothing, stall or leave, and more than there may be files."""

import asyncio
import http.client
import json
import logging
import socket
import time
from contextlib import contextmanager, suppress

import pytest
import uvicorn
from services import serving

from piccolo.apps.service import connections

TIER = "process"

FORM = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\n"
PART = b'--x\r\nContent-Disposition: form-data; name="picture"; filename="a.jpg"\r\n\r\n'
STALL_S = 0.5


def _request(content):
    body = PART + content + b"\r\n--x--\r\n"
    return FORM + b"Content-Length: %d\r\n\r\n" % len(body) + body


@contextmanager
def _connected(port, count, sent=b""):
    """So many connections that have sent the beginning of a request."""
    clients = []
    for _ in range(count):
        clients.append(socket.create_connection(("127.0.0.1", port), timeout=60))
        clients[-1].sendall(sent)
    yield clients
    for client in clients:
        client.close()


@pytest.fixture(scope="module")
def photo(scene):
    return (scene / "images" / "clean_0.jpg").read_bytes()


def test_silent_connections_and_unfinished_uploads_keep_nobody_out(scene, photo):
    words = [
        "--cloud",
        scene / "cloud.ply",
        "--cache",
        scene.parent / "maps",
        "--jobs",
        "1",
        "--max-waiting",
        "2",
    ]
    few = ["sh", "-c", 'ulimit -n 130; exec "$@"', "sh"]
    unfinished = FORM + b"Content-Length: 9000000\r\n\r\n" + PART + bytes(1_500_000)
    with serving(*words, before=few) as client:
        for sent in (b"", b"GET / HTTP/1.1\r\n", unfinished):
            with _connected(client.port, 150 if sent != unfinished else 20, sent):
                assert client.post("/localize", "a.jpg", photo)[0] == 200
    assert len(client.rest.splitlines()) < 5


@pytest.fixture(scope="module")
def service(scene):
    with serving("--cloud", scene / "cloud.ply", "--cache", scene.parent / "maps", "--jobs", "1") as client:
        yield client
    assert "Task exception" not in client.rest


def test_who_leaves_is_not_computed(service, photo):
    """Who comes after them waits for the photo at work, not for all of theirs."""

    def post():
        start = time.monotonic()
        assert service.post("/localize", "a.jpg", photo)[0] == 200
        return time.monotonic() - start

    alone = min(post() for _ in range(3))
    with _connected(service.port, 24, _request(photo)):
        while json.loads(service.ask("GET", "/health")[2])["waiting"] < 18:
            time.sleep(0.01)
    assert post() < 9 * alone
    assert json.loads(service.ask("GET", "/health")[2])["waiting"] == 0


async def _echo(scope, receive, send):
    size = 0
    more = True
    while more:
        message = await receive()
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"1000000")]})
    await send({"type": "http.response.body", "body": bytes(1_000_000)})


def _run(monkeypatch, talk):
    """What a function returns that is given a connection to an application."""
    monkeypatch.setattr(connections, "STALL_S", STALL_S)
    monkeypatch.setattr(connections, "LOOK_S", 0.1)

    def connect(port):
        with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
            return talk(client)

    async def run():
        server = uvicorn.Server(connections.configure(_echo, 1, 1.0))
        with connections.listen("127.0.0.1", 0) as listening:
            serving = asyncio.create_task(server.serve(sockets=[listening]))
            found = await asyncio.to_thread(connect, listening.getsockname()[1])
            server.should_exit = True
            await serving
        return found

    return asyncio.run(run())


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\n", FORM + b"Content-Length: 9\r\n\r\n1234"])
def test_what_stalls_is_ended(monkeypatch, sent):
    def talk(client):
        start = time.monotonic()
        client.sendall(sent)
        return client.recv(1000), time.monotonic() - start

    answer, seconds = _run(monkeypatch, talk)
    assert STALL_S <= seconds < STALL_S + 2
    assert answer == (connections.LATE if sent.startswith(b"POST") else b"")


def test_a_slow_upload_is_none_that_stalls(monkeypatch):
    """It takes several times as long as a step of it may take."""

    def talk(client):
        client.sendall(FORM + b"Content-Length: %d\r\n\r\n" % (10 * connections.BODY_STEP))
        for _ in range(10):
            time.sleep(STALL_S / 2)
            client.sendall(bytes(connections.BODY_STEP))
        return client.recv(1000)

    assert _run(monkeypatch, talk).startswith(b"HTTP/1.1 200 OK")


def test_who_does_not_read_is_ended(monkeypatch):
    def talk(client):
        client.sendall(20 * b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        time.sleep(4 * STALL_S)
        size = 0
        with suppress(ConnectionError):
            while content := client.recv(1 << 20):
                size += len(content)
        return size

    assert _run(monkeypatch, talk) < 20_000_000


def test_a_kept_connection_is_answered_at_once(service):
    connection = http.client.HTTPConnection("127.0.0.1", service.port)
    seconds = []
    for _ in range(9):
        start = time.perf_counter()
        connection.request(
            "GET", "/health", headers={"Content-Length": "5"} if not seconds else {}, body=None
        )
        if not seconds:
            connection.send(b"12345")
        connection.getresponse().read()
        seconds.append(time.perf_counter() - start)
    connection.close()
    assert sorted(seconds)[4] < 0.03


def test_the_log_says_a_thing_a_few_times(caplog):
    throttle = connections.Throttle()
    records = [logging.LogRecord("x", logging.ERROR, "", 0, "said %s", (k,), None) for k in range(9)]
    assert sum(map(throttle.filter, records)) == connections.LINES
    error = OSError(24, "Too many open files")
    record = logging.LogRecord("y", logging.ERROR, "", 0, "accept\nof", None, (OSError, error, None))
    assert throttle.filter(record)
    assert record.getMessage() == "accept: [Errno 24] Too many open files"
    assert record.exc_info is None
