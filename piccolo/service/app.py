"""The service over HTTP: photos in, lines of results out; and the page on which photos are dropped."""

import asyncio
import json
import logging
import secrets
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import fields, replace
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from .. import __version__
from ..batch.localizer import Task
from ..errors import InputError
from ..files.atomic import write_atomically
from ..jobs.processes import Processes, TooSlowError, WorkerLostError
from ..localization.settings import CoarseToFineSettings
from ..report import site
from ..result import FAILED, UNREADABLE, Result
from ..walk.frames import Motion
from .asking import apply_options, check_names, clean_name, make_photo, parse_options
from .desk import Desk, Drawing, Limits, WalkDesk, look_at
from .guard import COOKIE, Guard, refuse

LOG = logging.getLogger(__name__)
MAX_OPTIONS = 1 << 16  # [byte] of the options' text
MAX_WALKS = 4  # at once, each with a process
SETTLED_S = 1.0  # [s] for which the files of a scan must not change before they are opened again
RETRY = {"Retry-After": "2"}
LINES = "application/x-ndjson"
TYPES = {".js": "text/javascript", ".css": "text/css"}


class Asked(NamedTuple):
    """A photo that was sent."""

    task: Task
    content: bytes
    time: float | None  # of a frame


class Service:
    """Answers requests: of one event loop, while the work is done in other processes."""

    def __init__(self, open_desk: Callable[[], Desk], limits: Limits, keep: Path | None) -> None:
        self.open_desk = open_desk
        self.limits = limits
        self.keep = keep
        self.desk = open_desk()
        self.num_waiting = 0
        self.walks: dict[str, WalkDesk] = {}
        self.reopening: asyncio.Task[None] | None = None

    def close(self) -> None:
        """End all processes."""
        self.desk.processes.close()
        for walk in self.walks.values():
            walk.close()

    async def page(self, request: Request) -> Response:
        """Return the page, or a file of it."""
        self.look_for_another_scan()
        name = request.url.path.removeprefix("/")
        if name in self.desk.plans:
            return Response(self.desk.plans[name], media_type="image/png")
        if name == "report.js":
            return Response(site.report_script(self.desk.document), media_type=TYPES[".js"])
        if name in site.PAGE_FILES:
            return Response(site.page_file(name), media_type=TYPES[Path(name).suffix])
        if name:
            raise HTTPException(404, "found no such plan")
        policy = site.POLICY.format(script=site.OWN, style=site.OWN)
        return Response(site.page_under(f"{policy}; connect-src 'self'"), media_type="text/html")

    async def enter(self, request: Request) -> Response:
        """Take the token from the address into a cookie."""
        response = RedirectResponse("/", 303)
        response.set_cookie(COOKIE, request.query_params.get("token", ""), httponly=True, samesite="lax")
        return response

    async def scan(self, request: Request) -> Response:
        """Return what is known of the scan: storeys with plans, extent, coordinate system."""
        self.look_for_another_scan()
        return JSONResponse({**self.desk.document, "extent": self.desk.extent})

    async def health(self, request: Request) -> Response:
        """Return that the service runs, and how many photos wait."""
        return JSONResponse({"status": "ok", "version": __version__, "waiting": self.num_waiting})

    async def describe(self, request: Request) -> Response:
        """Return the OpenAPI description."""
        text = (files("piccolo.service") / "openapi.json").read_text(encoding="utf-8")
        return Response(text.replace("{{version}}", __version__), media_type="application/json")

    async def localize(self, request: Request) -> Response:
        """Return the line of a photo, as localize.py writes it."""
        async with self.asking(request) as (asked, desk):
            result = await self.answer(desk, asked)
        return Response(result.to_json(), media_type="application/json")

    async def show(self, request: Request) -> Response:
        """Return a photo for the page: a line with its result, then a line with its pictures."""
        async with self.asking(request) as (asked, desk):
            result = await self.answer(desk, asked)
        line = result.to_json()
        entry = json.dumps(desk.describe(result, secrets.token_hex(16)))

        async def lines() -> AsyncIterator[str]:
            yield f'{{"photo": {entry}, "result": {line}}}\n'
            with desk.at_work():
                pictures = await work(desk.processes, Drawing(asked.task, line))
            yield f"{pictures}\n"

        return StreamingResponse(lines(), media_type=LINES)

    async def begin_walk(self, request: Request) -> Response:
        """Begin a walk; return its name."""
        if len(self.walks) >= MAX_WALKS:
            raise HTTPException(503, f"found {MAX_WALKS} walks at once, wanted fewer: end one", RETRY)
        options = parse_options((await request.body()).decode(errors="replace"))
        given = options.get("motion", {})
        check_names(given, {f.name for f in fields(Motion)}, "options.motion")
        localizer = self.desk.localizer
        localizer = replace(localizer, settings=self.settings_of(options))
        name = secrets.token_hex(8)
        self.walks[name] = WalkDesk(localizer, Motion(**given), self.limits.seconds)
        return JSONResponse({"walk": name}, 201, {"Location": f"/walks/{name}"})

    async def follow(self, request: Request) -> Response:
        """Return the line of a walk's next frame, by it and the frames before."""
        name, walk = self.find_walk(request)
        async with self.asking(request) as (asked, _):
            frame = walk.keep(asked.task.photo, asked.content, asked.time)
            line = await self.step(name, walk, frame)
        return Response(line, media_type="application/json")

    async def end_walk(self, request: Request) -> Response:
        """Return the lines of all frames of a walk, by all of them; it is over then."""
        name, walk = self.find_walk(request)
        lines = await self.step(name, walk, None)
        self.forget(name)
        return Response("".join(f"{line}\n" for line in lines), media_type=LINES)

    def find_walk(self, request: Request) -> tuple[str, WalkDesk]:
        """Return a walk that has begun and is not over, by its name."""
        name = request.path_params["walk"]
        if name not in self.walks:
            raise HTTPException(404, "found no such walk, wanted one that POST /walks began")
        return name, self.walks[name]

    async def step(self, name: str, walk: WalkDesk, frame: object) -> Any:
        """Ask a walk's process; a walk whose process is lost is over."""
        try:
            return await work(walk.processes, frame)
        except HTTPException as error:
            if error.status_code >= 500:
                self.forget(name)
            raise

    def forget(self, name: str) -> None:
        """End a walk's process, and remove its frames."""
        if walk := self.walks.pop(name, None):
            walk.close()

    @asynccontextmanager
    async def asking(self, request: Request) -> AsyncIterator[tuple[Asked, Desk]]:
        """Yield what a request asks, and the desk that is to answer it; HTTPException if too many do."""
        self.look_for_another_scan()
        if self.num_waiting >= self.limits.max_waiting:
            raise HTTPException(503, f"found {self.num_waiting} photos that wait, try again", RETRY)
        self.num_waiting += 1
        try:
            asked = await self.read(request)
            with self.desk.at_work():
                yield asked, self.desk
        finally:
            self.num_waiting -= 1

    async def read(self, request: Request) -> Asked:
        """Return the photo in a form of the parts `picture` and `options`."""
        async with request.form(max_files=1, max_fields=1, max_part_size=MAX_OPTIONS) as form:
            picture = form.get("picture")
            text = form.get("options", "")
            if not isinstance(picture, UploadFile) or not isinstance(text, str):
                wanted = "wanted multipart/form-data with `picture`, a file, and perhaps `options`, JSON"
                raise HTTPException(400, f"found no picture, {wanted}")
            content = await picture.read()
            name = clean_name(picture.filename or "")
        options = parse_options(text)
        photo = make_photo(name, options)
        task = Task(photo, self.settings_of(options), {name: content})
        return Asked(task, content, options.get("time"))

    def settings_of(self, options: dict[str, Any]) -> CoarseToFineSettings:
        """Return the service's settings with a request's own in their place."""
        settings = self.desk.localizer.settings
        assert isinstance(settings, CoarseToFineSettings)
        return apply_options(settings, options)

    async def answer(self, desk: Desk, asked: Asked) -> Result:
        """Localize a photo; HTTPException for one that can't be read."""
        result: Result = (await work(desk.processes, asked.task)).result
        if result.status in (UNREADABLE, FAILED):
            again = (
                {"status_code": 503, "headers": RETRY} if result.status == FAILED else {"status_code": 422}
            )
            raise HTTPException(detail=result.error or "", **again)
        if self.keep:
            await asyncio.to_thread(self.keep_photo, self.keep, asked, result)
        return result

    def keep_photo(self, folder: Path, asked: Asked, result: Result) -> None:
        """Write a photo into a folder, under a name that no other has, and its line after those there."""
        path = folder / f"{sha256(asked.content).hexdigest()[:12]}-{asked.task.photo.path.name}"
        write_atomically(path, asked.content)
        with (folder / "results.jsonl").open("a") as file:
            file.write(f"{replace(result, pano=str(path)).to_json()}\n")

    def look_for_another_scan(self) -> None:
        """Begin to open the scan again if its files are others now; until it is open the old one answers."""
        if self.reopening is None and look_at(self.desk.localizer.paths) != self.desk.files:
            self.reopening = asyncio.create_task(self.reopen())

    async def reopen(self) -> None:
        """Open the scan again when its files have settled; keep the old one if they can't be read."""
        paths = self.desk.localizer.paths
        seen = None
        while seen != (seen := look_at(paths)):
            await asyncio.sleep(SETTLED_S)
        try:
            desk = await asyncio.to_thread(self.open_desk)
            self.desk.retire()
            self.desk = desk
            LOG.warning("the scan was replaced: photos are localized in the new one")
        except (InputError, OSError) as error:
            self.desk.files = seen
            LOG.warning("the scan was replaced by one that can't be opened, the old one stays: %s", error)
        self.reopening = None


async def work(processes: Processes, item: object) -> Any:
    """Return what a process says of an item; HTTPException for what it refuses, or did not live to say."""
    try:
        return await asyncio.wrap_future(processes.submit(item))
    except InputError as error:
        raise HTTPException(422, str(error)) from error
    except (TooSlowError, WorkerLostError) as error:
        raise HTTPException(500, f"the photo was given up: {error}") from error


def make_app(service: Service, token: str | None) -> Starlette:
    """Return the application of a service; with a token, only who knows it may ask."""
    routes = [
        Route("/enter", service.enter),
        Route("/scan", service.scan),
        Route("/health", service.health),
        Route("/openapi.json", service.describe),
        Route("/localize", service.localize, methods=["POST"]),
        Route("/show", service.show, methods=["POST"]),
        Route("/walks", service.begin_walk, methods=["POST"]),
        Route("/walks/{walk}", service.follow, methods=["POST"]),
        Route("/walks/{walk}", service.end_walk, methods=["DELETE"]),
        *(Route(path, service.page) for path in ("/", "/report.js", "/app.js", "/app.css", "/plans/{name}")),
    ]

    @asynccontextmanager
    async def closing(app: Starlette) -> AsyncIterator[None]:
        try:
            yield
        finally:
            service.close()

    async def refuse_http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return refuse(error)

    async def refuse_input(request: Request, error: Exception) -> Response:
        return refuse(HTTPException(400, str(error)))

    return Starlette(
        routes=routes,
        middleware=[Middleware(Guard, max_bytes=service.limits.max_bytes, token=token)],
        exception_handlers={HTTPException: refuse_http, InputError: refuse_input},
        lifespan=closing,
    )
