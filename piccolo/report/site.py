"""The files of a report: a page that opens from disk, its data as scripts, pictures beside it.

A page of file:// may run scripts and show images beside it, but fetch nothing, and read no pixel of them:
what WebGL shows lies in scripts, one a photo. Names of files are digests of what they were made from, so that
what is there already need not be made again. One file holds all of it where the report is self-contained.
"""

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files.atomic import is_stream, write_atomically

INDEX = "index.html"
PAGE_FILES = ("app.js", "app.css")
FOLDERS = {"photos": ".js", "thumbs": ".jpg", "plans": ".png"}
KEY = re.compile(r"[0-9a-f]{32}")
MARK = "piccolo-report"  # in the page, by which a folder is known as a report
# of a page on disk: the origin of a file is nobody's, so that 'self' alone may match nothing
POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; img-src 'self' file: data: blob:; "
    "script-src {script}; style-src {style}"
)
OWN = "'self' file:"


def page_file(name: str) -> str:
    """Return a file of the page, as the package has it."""
    return (files("piccolo.report") / "page" / name).read_text(encoding="utf-8")


def as_script_text(document: object) -> str:
    """JSON that may stand in a script: nothing in it can end one."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def check_folder(out: Path) -> None:
    """Refuse a folder that could not be made, or that has something in it which is no report."""
    if is_stream(out) or (out.exists() and not out.is_dir()):
        raise InputError(f"{out}: found a file or a device, wanted a folder")
    if not out.parent.is_dir():
        raise InputError(f"{out}: found no folder {out.parent}, wanted one that exists")
    if out.exists() and any(out.iterdir()) and not (out / f".{MARK}").is_file():
        raise InputError(f"{out}: found a folder of something else, wanted a new or empty one, or a report")


def begin_folder(out: Path) -> None:
    """Make the folders, and mark them as a report's."""
    for name in FOLDERS:
        (out / name).mkdir(parents=True, exist_ok=True)
    write_atomically(out / f".{MARK}", b"Files here are replaced by tools/report.py.\n")


def picture_path(out: Path, folder: str, key: str) -> Path:
    """Return the path of a photo's or plan's file."""
    return out / folder / f"{key}{FOLDERS[folder]}"


def write_photo_script(out: Path, key: str, document: str) -> None:
    """Write the pictures of a photo, in JSON, as a script that hands them to the page."""
    text = f'(window.PICCOLO_PHOTOS ??= {{}})["{key}"] = {document};\n'
    write_atomically(picture_path(out, "photos", key), text.encode())


def finish_folder(out: Path, document: Mapping[str, Any]) -> None:
    """Write the page and its data, and remove what earlier reports here left of photos."""
    for name in PAGE_FILES:
        write_atomically(out / name, page_file(name).encode())
    script = f"window.PICCOLO_REPORT = {as_script_text(document)};\n"
    write_atomically(out / "report.js", script.encode())
    page = page_file(INDEX).replace("{{policy}}", POLICY.format(script=OWN, style=OWN))
    write_atomically(out / INDEX, page.encode())
    used = {str(photo["key"]) for photo in document["photos"]}
    used |= {Path(s["plan"]["file"]).stem for s in document["storeys"] if s["plan"]}
    for name, suffix in FOLDERS.items():
        for path in (out / name).iterdir():
            is_ours = path.suffix == suffix and KEY.fullmatch(path.stem)
            is_left = path.name.startswith(".") and KEY.match(path.name.lstrip("."))
            if (is_ours and path.stem not in used) or is_left:
                path.unlink()


def self_contained(folder: Path, document: Mapping[str, Any]) -> str:
    """Return the page with everything in it; its pictures lie in a folder, as those of other reports do."""
    inlined = json.loads(json.dumps(document))
    for photo in inlined["photos"]:
        if photo["thumb"]:
            photo["thumb"] = _data_url(folder / photo["thumb"], "image/jpeg")
    for storey in inlined["storeys"]:
        if storey["plan"]:
            storey["plan"]["file"] = _data_url(folder / storey["plan"]["file"], "image/png")
    script = page_file("app.js")
    style = page_file("app.css")
    data = [f'<script type="application/json" id="report">{as_script_text(inlined)}</script>']
    for photo in document["photos"]:
        if photo["hasPictures"]:
            script_of_photo = picture_path(folder, "photos", photo["key"]).read_text()
            text = script_of_photo.partition(" = ")[2].removesuffix(";\n")
            data.append(f'<script type="application/json" id="photo-{photo["key"]}">{text}</script>')
    page = page_file(INDEX)
    page = page.replace("{{policy}}", POLICY.format(script=_hash_of(script), style=_hash_of(style)))
    page = page.replace('<link rel="stylesheet" href="app.css">', f"<style>{style}</style>")
    page = page.replace('<script defer src="report.js"></script>', "")
    page = page.replace('<script defer src="app.js"></script>', "")
    return page.replace("</body>", "\n".join([*data, f"<script>{script}</script>", "</body>"]))


def _hash_of(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _data_url(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
