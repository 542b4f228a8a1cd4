"""Services that are started by their command, and what asks them over HTTP."""

import http.client
import json
import signal
import subprocess
import sys
import threading
import uuid
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 60.0  # for a message that has to come


class Client:
    """Asks a service that runs at a port."""

    def __init__(self, port, process):
        self.port = port
        self.process = process
        self.is_told_to_end = False

    def end(self):
        """Send SIGTERM, once: a second one kills the interpreter while it shuts down."""
        if not self.is_told_to_end and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        self.is_told_to_end = True

    def says(self, words):
        """Wait for a message with these words; False if it ends, or is ended, before it says them."""
        patience = threading.Timer(PATIENCE_S, self.process.kill)
        patience.start()
        try:
            return any(words in line for line in self.process.stderr)
        finally:
            patience.cancel()

    def ask(self, method, path, body=b"", **headers):
        """Status, headers and body of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        connection.request(method, path, body, {name.replace("_", "-"): v for name, v in headers.items()})
        answer = connection.getresponse()
        found = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return found

    def post(self, path, name, content, options=None, **headers):
        """The same of a picture that is sent as a form."""
        return self.post_all(path, {name: content}, options, **headers)

    def post_all(self, path, pictures, options=None, **headers):
        """The same of several pictures, by their names."""
        mark = uuid.uuid4().hex
        parts = [("picture", f'; filename="{name}"', content) for name, content in pictures.items()]
        if options is not None:
            text = options if isinstance(options, str) else json.dumps(options)
            parts.append(("options", "", text.encode()))
        body = b"".join(
            f'--{mark}\r\nContent-Disposition: form-data; name="{key}"{more}\r\n\r\n'.encode()
            + value
            + b"\r\n"
            for key, more, value in parts
        )
        kind = f"multipart/form-data; boundary={mark}"
        return self.ask("POST", path, body + f"--{mark}--\r\n".encode(), Content_Type=kind, **headers)


@contextmanager
def serving(*words, before=()):
    """A client of a service that is started with some options, and ended by SIGTERM."""
    command = [*before, sys.executable, str(ROOT / "tools/serve.py"), "--port", "0", *map(str, words)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    lines = []
    for line in process.stderr:
        lines.append(line)
        if " open http" in line:
            break
    else:
        pytest.fail("".join(lines))
    address = lines[-1].split(" open ")[1].split()[0]
    port = words[words.index("--port") + 1] if "--port" in words else address.split(":")[2].split("/")[0]
    client = Client(int(port), process)
    client.address = address
    try:
        yield client
    finally:
        client.end()
        client.rest = process.communicate(timeout=60)[1]
