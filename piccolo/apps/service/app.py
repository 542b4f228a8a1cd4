"""The service over HTTP: it takes photos and returns lines of results, and serves the page for them."""

import asyncio
import json
import logging
import secrets
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import FormData
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from ... import __version__
from ...api.values import FAILED, UNREADABLE, CoarseToFineSettings, Result
from ...batch.localizer import Task
from ...photo.photo import Photo
from ...scan_map.scan_map import ScanMap
from ...system.errors import InputError
from ...system.jobs.processes import OpeningError, Processes, TooSlowError, WorkerLostError
from ..report import site
from .access import Access
from .asking import FORM, apply_options, are_together, make_asked_photo, parse_options, read_form
from .description import describe_service
from .desk import Desk, Drawing, RequestLimits, Sent, content_of, look_at
from .guard import COOKIE, RETRY, SHORTAGE, Guard, answer_refusal, refusal_of, refusing_shortage
from .keep import Keep

LOG = logging.getLogger(__name__)
MAX_OPTIONS = 1 << 16  # [byte] of the options' text
MAX_FORM_PARTS = 64  # of a form; one with more is refused
SETTLED_S = 1.0  # [s] a changed scan is opened again when its files have not changed for so long
LINES = "application/x-ndjson"
UNBUFFERED = {"X-Accel-Buffering": "no"}  # tells nginx to pass each line on at once
CORS: dict[str, Any] = {"allow_methods": ["GET", "POST"], "allow_headers": ["Authorization"]}
CORS |= {"expose_headers": ["Retry-After"]}
TYPES = {".js": "text/javascript", ".css": "text/css"}


class Service:
    """The handlers of requests: they run in one event loop, the work is done in other processes."""

    def __init__(
        self, open_desk: Callable[[], Desk], limits: RequestLimits, keep: Keep | None, access: Access
    ) -> None:
        self.open_desk = open_desk
        self.limits = limits
        self.keep = keep
        self.access = access
        self.desk = open_desk()
        self.num_waiting = 0
        self.reopening: asyncio.Task[None] | None = None

    def close(self) -> None:
        """End all processes."""
        self.desk.close()

    async def page(self, request: Request) -> Response:
        """Return the page, or one of its files."""
        self.look_for_another_scan()
        name = request.url.path.removeprefix("/")
        if name in self.desk.plans:
            return Response(self.desk.plans[name], media_type="image/png")
        if name == "report.js":
            document = await asyncio.to_thread(self.document)
            return Response(site.report_script(document), media_type=TYPES[".js"])
        if name in site.PAGE_FILES:
            return Response(site.page_file(name), media_type=TYPES[Path(name).suffix])
        if name:
            raise HTTPException(404, "found no such plan")
        policy = site.POLICY.format(script=site.OWN, style=site.OWN)
        return Response(site.page_under(f"{policy}; connect-src 'self'"), media_type="text/html")

    def document(self) -> dict[str, Any]:
        """Return the data with which the page opens: the scan, and the photos that are kept."""
        photos = self.keep.photos(self.desk.scan_map) if self.keep else []
        return {**self.desk.document, "photos": photos}

    async def enter(self, request: Request) -> Response:
        """Move the token from the address into a cookie, and open the page."""
        sent_token = request.query_params.get("token", "")
        token = self.access.token
        if token is None or not secrets.compare_digest(sent_token.encode(), token.encode()):
            raise HTTPException(401, "found another token, wanted the one that the service printed")
        path = self.access.path
        response = RedirectResponse(path, 303)
        secure = self.access.is_secure
        response.set_cookie(COOKIE, token, path=path, secure=secure, httponly=True, samesite="lax")
        return response

    async def scan(self, request: Request) -> Response:
        """Return the description of the scan: storeys with plans, extent, coordinate system."""
        self.look_for_another_scan()
        return JSONResponse(self.desk.document)

    async def health(self, request: Request) -> Response:
        """Report that the service runs, and how many photos wait."""
        return JSONResponse({"status": "ok", "version": __version__, "waiting": self.num_waiting})

    async def describe(self, request: Request) -> Response:
        """Return the OpenAPI description."""
        return JSONResponse(describe_service())

    async def docs(self, request: Request) -> Response:
        """Return a page on which a request can be tried."""
        text = (files("piccolo.apps.service") / "docs.html").read_text(encoding="utf-8")
        return Response(text, media_type="text/html")

    async def localize(self, request: Request) -> Response:
        """Localize photos; return a line of JSON for each, as localize.py writes it."""
        async with self.asking(request) as sent:
            with self.desk.in_use() as desk:
                results = await unless_gone(request, self.answer(desk, sent))
                for task, result in zip(sent.tasks, results, strict=True):
                    await self.keep_photo(task, result)
        if len(results) == 1:
            return Response(results[0].to_json(), media_type="application/json")
        return Response("".join(f"{result.to_json()}\n" for result in results), media_type=LINES)

    async def show(self, request: Request) -> Response:
        """Localize photos for the page; return, for each, a line with its result and one with pictures."""
        async with self.asking(request) as sent:
            with self.desk.in_use() as desk:
                results = await unless_gone(request, self.answer(desk, sent))
                kept = [await self.keep_photo(*one) for one in zip(sent.tasks, results, strict=True)]

        async def lines() -> AsyncIterator[str]:
            for task, result, name in zip(sent.tasks, results, kept, strict=True):
                about = photo_document(name or result.pano, result, desk.scan_map)
                yield f'{{"photo": {json.dumps(about)}, "result": {result.to_json()}}}\n'
                with desk.in_use():
                    try:
                        yield f"{await self.draw(desk, Drawing(task, result), name)}\n"
                    except HTTPException as error:
                        yield f"{json.dumps({'error': error.detail})}\n"

        return StreamingResponse(lines(), media_type=LINES, headers=UNBUFFERED)

    async def keep_photo(self, task: Task, result: Result) -> str | None:
        """Keep a photo, if the service keeps any, and return its name in the folder; else return None."""
        if self.keep is None or result.error is not None:
            return None
        return await asyncio.to_thread(self.keep.add, task.photo.name, content_of(task), result)

    async def draw(self, desk: Desk, drawing: Drawing, kept: str | None) -> str:
        """Return JSON of a photo's thumbnail and pictures; if it is kept, as `kept`, keep the thumbnail."""
        text: str = await work(desk.processes, drawing)
        if self.keep and kept:
            with refusing_shortage():
                await asyncio.to_thread(self.keep.add_thumb, kept, json.loads(text)["thumb"])
        return text

    async def photo(self, request: Request) -> Response:
        """Return the script with the pictures of a photo that is kept."""
        key = request.path_params["key"]
        kept = await asyncio.to_thread(self.keep.find, key) if self.keep else None
        if kept is None:
            raise HTTPException(404, "found no such photo")
        content, result = kept
        name = Path(result.pano).name
        settings = self.desk.localizer.settings
        with self.place(), self.desk.in_use() as desk:
            task = Task(Photo(Path(name)), settings, {name: content})
            text = await self.draw(desk, Drawing(task, replace(result, pano=name)), name)
        script = site.photo_script(key, json.dumps(json.loads(text)["pictures"]))
        return Response(script, media_type=TYPES[".js"])

    async def thumb(self, request: Request) -> Response:
        """Return the thumbnail of a photo that is kept."""
        key = request.path_params["key"]
        thumbnail = await asyncio.to_thread(self.keep.find_thumb, key) if self.keep else None
        if thumbnail is None:
            raise HTTPException(404, "found no such thumbnail")
        return Response(thumbnail, media_type="image/jpeg")

    @asynccontextmanager
    async def asking(self, request: Request) -> AsyncIterator[Sent]:
        """Yield the photos of a request when all of it was received. Raise HTTPException if too many wait."""
        self.look_for_another_scan()
        if request.query_params:
            raise HTTPException(400, f"found {min(request.query_params)!r} in the address, {FORM}")
        async with reading_form(request) as form:
            with self.place(len(form.getlist("picture"))):
                pictures, text = await read_form(form)
                await form.close()
                options = parse_options(text)
                settings = self.settings_of(options)
                photos = {name: make_asked_photo(name, options) for name in pictures}
                tasks = [Task(photo, settings, {name: pictures[name]}) for name, photo in photos.items()]
                yield Sent(tasks, are_together(options))

    @contextmanager
    def place(self, num: int = 1) -> Iterator[None]:
        """Count `num` photos as waiting within the block. HTTPException if `max_waiting` wait already."""
        if self.num_waiting >= self.limits.max_waiting:
            raise HTTPException(503, f"found {self.num_waiting} photos that wait, try again", RETRY)
        self.num_waiting += num
        try:
            yield
        finally:
            self.num_waiting -= num

    def settings_of(self, options: dict[str, Any]) -> CoarseToFineSettings:
        """Return the settings of a request: the service's, replaced where it has options."""
        settings = self.desk.localizer.settings
        assert isinstance(settings, CoarseToFineSettings)
        return apply_options(settings, options)

    async def answer(self, desk: Desk, sent: Sent) -> list[Result]:
        """Localize the photos of a request. Raise HTTPException for a single photo that can't be read."""
        results: list[Result] = await work(desk.processes, sent, len(sent.tasks))
        for result in results:
            if result.status == FAILED:
                LOG.warning("a photo was given up: %s", result.error)
        if len(results) > 1:
            return results
        if results[0].status == FAILED:
            raise HTTPException(503, results[0].error, RETRY)
        if results[0].status == UNREADABLE:
            raise HTTPException(422, results[0].error)
        return results

    def look_for_another_scan(self) -> None:
        """Begin to open the scan again if its files have changed; until it is open, the old one is used."""
        if self.reopening is None and look_at(self.desk.localizer.paths) != self.desk.files:
            self.reopening = asyncio.create_task(self.reopen())

    async def reopen(self) -> None:
        """Open the scan again when its files no longer change; keep the old one if they can't be read."""
        paths = self.desk.localizer.paths
        files_now = None
        while files_now != (files_now := look_at(paths)):
            await asyncio.sleep(SETTLED_S)
        try:
            desk = await asyncio.to_thread(self.open_desk)
            self.desk.retire()
            self.desk = desk
            digest = self.desk.scan_map.scan_sha256[:12]
            LOG.warning("the scan was replaced: photos are localized in the new one, SHA-256 %s...", digest)
        except (InputError, OSError) as error:
            self.desk.files = files_now
            LOG.warning("the scan was replaced by one that can't be opened, the old one stays: %s", error)
        finally:
            self.reopening = None


@asynccontextmanager
async def reading_form(request: Request) -> AsyncIterator[FormData]:
    """Yield the form of a request. Raise HTTPException for a broken one; it says what to send."""
    limits = {"max_files": MAX_FORM_PARTS, "max_fields": MAX_FORM_PARTS, "max_part_size": MAX_OPTIONS}
    try:
        form = await request.form(**limits)
    except HTTPException as error:
        if error.status_code != 400:
            raise
        raise HTTPException(400, f"{error.detail.rstrip('.')}; {FORM}") from error
    try:
        yield form
    finally:
        await form.close()


async def unless_gone(request: Request, answer: Coroutine[Any, Any, list[Result]]) -> list[Result]:
    """Return an answer, or give it up and raise ClientDisconnect if the client leaves before."""
    answering = asyncio.create_task(answer)
    leaving = asyncio.ensure_future(request.receive())  # the body was read: only a disconnection can come
    try:
        await asyncio.wait({answering, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not answering.done():
            raise ClientDisconnect
        return answering.result()
    finally:
        leaving.cancel()
        answering.cancel()
        await asyncio.gather(leaving, answering, return_exceptions=True)


async def work(processes: Processes, item: object, num: int = 1) -> Any:
    """Return a process's answer to an item. Raise HTTPException if it refuses the item, or ends before."""
    future = None
    try:
        future = processes.submit(item, num)
        return await asyncio.wrap_future(future)
    except OpeningError as error:
        raise HTTPException(503, f"the scan can't be opened at the moment: {error}", RETRY) from error
    except SHORTAGE as error:
        raise refusal_of(error) from error
    except InputError as error:
        raise HTTPException(422, str(error)) from error
    except (TooSlowError, WorkerLostError) as error:
        raise HTTPException(500, f"the photo was given up: {error}") from error
    except (RuntimeError, asyncio.CancelledError) as error:
        if future is not None and not future.cancelled():
            raise
        raise HTTPException(503, "this scan was closed meanwhile", RETRY) from error


def photo_document(name: str, result: Result, scan_map: ScanMap) -> dict[str, Any]:
    """Return the data of a photo, which was just sent, for the page."""
    (short,) = site.shorten_names([result.pano])
    entry = site.document_of_entry(site.Entry(result, None, 0.0), name, secrets.token_hex(16), scan_map)
    return {**entry, "short": short, "hasPictures": True, "thumb": None}


def make_app(service: Service) -> Starlette:
    """Return the application of a service."""
    routes = [
        Route("/enter", service.enter),
        Route("/scan", service.scan),
        Route("/health", service.health),
        Route("/openapi.json", service.describe),
        Route("/docs", service.docs),
        Route("/localize", service.localize, methods=["POST"]),
        Route("/show", service.show, methods=["POST"]),
        Route("/photos/{key}.js", service.photo),
        Route("/thumbs/{key}.jpg", service.thumb),
        *(Route(path, service.page) for path in ("/", "/report.js", "/app.js", "/app.css", "/plans/{name}")),
    ]

    async def refuse_error(request: Request, error: Exception) -> Response:
        if isinstance(error, SHORTAGE):
            return answer_refusal(refusal_of(error))
        return answer_refusal(error if isinstance(error, HTTPException) else HTTPException(400, str(error)))

    refused = (HTTPException, InputError, ClientDisconnect, *SHORTAGE)

    return Starlette(
        routes=routes,
        middleware=[
            Middleware(CORSMiddleware, **CORS, allow_origins=service.access.origins),
            Middleware(Guard, max_bytes=service.limits.max_bytes, access=service.access),
        ],
        exception_handlers=dict.fromkeys(refused, refuse_error),
    )
