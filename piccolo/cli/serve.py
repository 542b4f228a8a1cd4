"""Serve a scan: a page to drop photos on, which shows where they were taken, and the same for programs."""

import os
import re
import secrets
import socket
from argparse import ArgumentParser
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..errors import InputError, import_optional
from ..files.atomic import temporary_folder
from ..files.json_file import read_text
from ..jobs.memory import GB, memory_taken
from ..jobs.threads import num_cores
from ..service.desk import Limits, open_desk
from ..service.keep import open_keep
from .command import Arguments, UsageError, checking_options, command, option
from .options import CACHE_TEXT, add_cloud_options, add_method_options
from .settings import localizer_from

EPILOG = """\
examples:
  python tools/serve.py --cloud scan.e57            # then open http://127.0.0.1:8765 in a browser
  curl -F picture=@photo.jpg http://127.0.0.1:8765/localize
  curl -F picture=@crop.jpg -F options='{"photo": {"fov_deg": 70}}' http://127.0.0.1:8765/localize
  python tools/serve.py --cloud house.map --host 0.0.0.0 --jobs 4 --keep photos

/localize answers the line of JSON that localize.py writes; /openapi.json describes all addresses. Only this
machine may ask, unless --host says otherwise: then a token is needed, which is printed as part of the page's
address. Photos are not kept without --keep. A scan that is replaced is opened again. Ctrl-C or SIGTERM lets
the photos at work finish. Needs the extra serve.
"""
TOKEN = re.compile(r"[\w-]{8,200}", re.ASCII)
HERE = "127.0.0.1"
ANY = ("0.0.0.0", "::")
MEGABYTE = 1e6
GRACE_S = 5.0  # [s] for answers to be sent, beyond those of a photo


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    option(parser, "--crs CRS", "coordinate system of the cloud, such as EPSG:25832; none: ignore GPS")
    option(parser, "--cache FOLDER", CACHE_TEXT)
    add_method_options(parser)
    group = parser.add_argument_group("service")
    option(group, "--host NAME", "address to listen at", default=HERE)
    option(group, "--port N", "port to listen at; 0: any that is free", default=8765)
    text = "file with the token that others must know (default with another --host: a new one, printed)"
    option(group, "--token FILE", text)
    option(group, "--keep FOLDER", "keep photos and results.jsonl in this folder, which exists")
    group = parser.add_argument_group("limits")
    option(group, "--jobs N", "processes, each with a photo at a time", default=num_cores())
    option(group, "--max-memory GB", "memory of all processes (default: 80 %% of what is free)")
    option(group, "--max-megabytes X", "size of a request", default=100.0)
    option(group, "--max-megapixels X", "size of a picture, by its header", default=200.0)
    option(group, "--max-waiting N", "photos at once, those at work included", default=32)
    option(group, "--max-seconds S", "time of a photo", default=60.0)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Open the scan, then answer requests until a signal comes; returns the exit code."""
    a = arguments
    a.check_least(jobs=1, port=0, max_megabytes=0.1, max_megapixels=0.01, max_waiting=1, max_seconds=0.1)
    uvicorn = import_optional("tools/serve.py", "uvicorn", "serve")
    for module in ("starlette", "python_multipart"):
        import_optional("tools/serve.py", module, "serve")
    from ..service import connections  # noqa: PLC0415  # the extra is known to be there
    from ..service.app import Service, make_app  # noqa: PLC0415
    from ..service.guard import LOOPBACK  # noqa: PLC0415

    with checking_options():
        localizer = localizer_from(arguments, tuple(arguments.cloud))
    if a.keep and not a.keep.is_dir():
        raise InputError(f"{a.keep}: found no folder, wanted one that exists")
    if a.quiet and not a.token and a.host not in LOOPBACK:
        raise UsageError("--quiet: the token would not be printed, wanted --token")
    token = None if a.host in LOOPBACK and not a.token else choose_token(a.token)
    limits = Limits(
        int(a.max_megabytes * MEGABYTE),
        a.max_megapixels * MEGABYTE,
        a.max_waiting,
        a.max_seconds,
    )
    memory = a.max_memory and (a.max_memory - memory_taken() / GB) / a.jobs
    localizer = replace(localizer, max_memory=memory)
    keeping = open_keep(a.keep) if a.keep else nullcontext()
    with listening(a.host, a.port) as server, temporary_folder() as folder, keeping as keep:
        os.environ["TMPDIR"] = str(folder)  # of the processes: what a killed one leaves goes at the end
        desk = partial(open_desk, localizer, a.jobs, limits, a.keep is not None, a.workers())
        service = Service(desk, limits, keep, token)
        a.warn(service.desk.scan_map.warnings)
        a.note(f"open {page_address(server, token)} in a browser; Ctrl-C ends it")
        with closing(service):
            config = connections.configure(make_app(service), a.jobs, limits.seconds + GRACE_S)
            uvicorn.Server(config).run(sockets=[server])
    return 0


def page_address(server: socket.socket, token: str | None) -> str:
    """Return the page's address, with the token if there is one."""
    name, port = server.getsockname()[:2]
    if name in ANY:
        name = socket.gethostname()
    host = f"[{name}]" if ":" in name else name
    return f"http://{host}:{port}/{f'enter?token={token}' if token else ''}"


def choose_token(path: Path | None) -> str:
    """Return the token in a file, or a new one."""
    if path:
        token = read_text(path, "wanted a token").strip()
        if not TOKEN.fullmatch(token):
            raise InputError(f"{path}: found no token, wanted 8 to 200 letters, digits, - and _ on one line")
        return token
    return secrets.token_urlsafe()


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens; InputError if the system gives none."""
    from ..service.connections import listen  # noqa: PLC0415  # the extra is known to be there

    try:
        return listen(host, port)
    except (OSError, OverflowError) as error:
        reason = str(getattr(error, "strerror", None) or error).partition(" (while")[0]
        raise InputError(f"--host {host} --port {port}: cannot be listened at ({reason})") from error
