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
from urllib.parse import urlsplit

from ...cli.command import Arguments, UsageError, checking_options, command, option
from ...cli.options import CACHE_TEXT, add_cloud_options, add_method_options
from ...cli.settings_given import localizer_from
from ...system.errors import InputError, import_optional, printable
from ...system.files.atomic import temporary_folder
from ...system.files.json_file import read_text
from ...system.jobs.memory import GB, memory_taken
from ...system.jobs.threads import num_cores
from .access import LOOPBACK, Access
from .desk import RequestLimits, open_desk
from .keep import open_keep

EPILOG = """\
examples:
  python tools/serve.py --cloud scan.e57            # then open http://127.0.0.1:8765 in a browser
  curl -F picture=@photo.jpg http://127.0.0.1:8765/localize
  curl -F picture=@crop.jpg -F options='{"photo": {"fov_deg": 70}}' http://127.0.0.1:8765/localize
  python tools/serve.py --cloud house.map --host 0.0.0.0 --jobs 4 --keep photos

/localize answers the line of JSON that localize.py writes; /docs tries it. Only this machine may ask, unless
--host or --public-url says otherwise: then a token is needed, which is printed as part of the page's address.
--host alone sends all in clear text; docs/recipes/proxy.md has HTTPS. Photos are not kept without --keep. A
scan that is replaced is opened again. Ctrl-C or SIGTERM lets photos at work finish. Needs the extra serve.
"""
TOKEN = re.compile(r"[\w-]{8,200}", re.ASCII)
HERE = "127.0.0.1"
ANY = ("0.0.0.0", "::")
MEGABYTE = 1e6
GRACE_S = 5.0  # [s] for sending answers, added to the time of a photo


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    option(parser, "--crs CRS", "coordinate system of the cloud, such as EPSG:25832; none: ignore GPS")
    option(parser, "--cache FOLDER", CACHE_TEXT)
    add_method_options(parser)
    group = parser.add_argument_group("service")
    option(group, "--host NAME", "address to listen at", default=HERE)
    option(group, "--port N", "port to listen at; 0: any that is free", default=8765)
    text = "file with the token that others must know (default with another --host: a new one, printed)"
    option(group, "--token FILE", text)
    text = "address of the page for others, of a proxy before this: https://scans.example/flat/"
    option(group, "--public-url URL", text)
    text = "other sites whose pages may ask, such as https://intranet.example"
    option(group, "--allow-origin URL ...", text, default=[])
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
    """Open the scan, then answer requests until a signal comes; return the exit code."""
    a = arguments
    a.check_least(jobs=1, port=0, max_megabytes=0.1, max_megapixels=0.01, max_waiting=1, max_seconds=0.1)
    uvicorn = import_optional("tools/serve.py", "uvicorn", "serve")
    for module in ("starlette", "python_multipart"):
        import_optional("tools/serve.py", module, "serve")
    from . import connections  # noqa: PLC0415  # the extra is known to be there
    from .app import Service, make_app  # noqa: PLC0415

    with checking_options():
        localizer = localizer_from(arguments, tuple(arguments.cloud))
        access = access_from(arguments)
    if a.keep and not a.keep.is_dir():
        raise InputError(f"{a.keep}: found no folder, wanted one that exists")
    limits = RequestLimits(
        int(a.max_megabytes * MEGABYTE),
        a.max_megapixels * MEGABYTE,
        a.max_waiting,
        a.max_seconds,
    )
    memory = a.max_memory and (a.max_memory - memory_taken() / GB) / a.jobs
    localizer = replace(localizer, max_memory=memory)
    keeping = open_keep(a.keep) if a.keep else nullcontext()
    with listening(a.host, a.port) as server, temporary_folder() as folder, keeping as keep:
        os.environ["TMPDIR"] = str(folder)  # for the processes: what a killed one leaves is removed
        desk = partial(open_desk, localizer, a.jobs, limits, a.keep is not None, a.workers())
        service = Service(desk, limits, keep, access)
        a.warn(service.desk.scan_map.warnings)
        enter = f"enter?token={access.token}" if access.token else ""
        a.note(f"open {access.public_url or page_address(server)}{enter} in a browser; Ctrl-C ends it")
        with closing(service):
            config = connections.configure(make_app(service), a.jobs, limits.seconds + GRACE_S)
            uvicorn.Server(config).run(sockets=[server])
    return 0


def access_from(a: Arguments) -> Access:
    """Return who may send requests: those with a token, unless only this machine can reach the service."""
    public_url = None if a.public_url is None else check_url("public_url", a.public_url, True)
    origins = tuple(check_url("allow_origin", url, False) for url in a.allow_origin)
    if a.host in LOOPBACK and not public_url and not a.token:
        return Access(None, None, origins)
    if a.quiet and not a.token:
        raise UsageError("--quiet: the token would not be printed, wanted --token")
    return Access(choose_token(a.token), public_url, origins)


def check_url(name: str, url: str, is_page: bool) -> str:
    """Return the address of a page, ending in /, or of a site, without a path; else raise InputError."""
    wanted = "http(s)://HOST/PATH/" if is_page else "http(s)://HOST"
    refusal = f"`{name}`: found {printable(url)!r}, wanted {wanted}"
    try:
        scheme, host, path, query, fragment = urlsplit(url)
    except ValueError as error:
        raise InputError(refusal) from error
    has_more = query or fragment or "@" in host or not (is_page or path in ("", "/"))
    if scheme not in ("http", "https") or not host or has_more or not url.isprintable():
        raise InputError(refusal)
    return f"{scheme}://{host.lower()}{path.rstrip('/')}{'/' if is_page else ''}"


def page_address(server: socket.socket) -> str:
    """Return the page's address for the user."""
    name, port = server.getsockname()[:2]
    if name in ANY:
        name = socket.gethostname()
    host = f"[{name}]" if ":" in name else name
    return f"http://{host}:{port}/"


def choose_token(path: Path | None) -> str:
    """Return the token in a file, or a new token without a file."""
    if path:
        token = read_text(path, "wanted a token").strip()
        if not TOKEN.fullmatch(token):
            raise InputError(f"{path}: found no token, wanted 8 to 200 letters, digits, - and _ on one line")
        return token
    return secrets.token_urlsafe()


def listening(host: str, port: int) -> socket.socket:
    """Return a listening socket. Raise InputError if the system refuses it."""
    from .connections import listen  # noqa: PLC0415  # the extra is known to be there

    try:
        return listen(host, port)
    except (OSError, OverflowError) as error:
        reason = str(getattr(error, "strerror", None) or error).partition(" (while")[0]
        raise InputError(f"--host {host} --port {port}: cannot be listened at ({reason})") from error
