"""A folder in which photos and their results are kept, so that the page shows them when it opens again."""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from threading import Lock
from typing import Any

from ...api.result_files import read_results
from ...api.values import Result
from ...scan_map.scan_map import ScanMap
from ...system.files.atomic import write_atomically
from ...system.files.line_file import LineFile, open_locked, whole_size
from ..report import site

RESULTS = "results.jsonl"
THUMBS = "thumbs"
MARK = 12  # digits of a photo's digest that are put before its name
BEGINS = b'{"'  # of each line of results


class Keep:
    """A folder of photos with unique names, and the file of their results."""

    def __init__(self, folder: Path, lines: LineFile) -> None:
        self.folder = folder
        self._lines = lines
        self._writing = Lock()
        lines.cut(whole_size(lines.path, BEGINS, "results"))
        results = read_results([lines.path]) if lines.size else []
        self._results = {Path(result.pano).name: result for result in results}

    def add(self, name: str, content: bytes, result: Result) -> str:
        """Keep a photo and its result, either both or none; return the photo's name in the folder."""
        own = f"{sha256(content).hexdigest()[:MARK]}-{name}"
        path = self.folder / own
        kept = replace(result, pano=str(path))
        with self._writing:
            is_new = not path.exists()
            write_atomically(path, content)
            try:
                self._lines.append(kept.to_json())
            except OSError:
                if is_new:
                    path.unlink()
                raise
            self._results[own] = kept
        return own

    def add_thumb(self, name: str, url: str) -> None:
        """Keep the thumbnail of a photo, a JPEG file given as a data URL."""
        thumbs = self.folder / THUMBS
        thumbs.mkdir(exist_ok=True)
        write_atomically(thumbs / f"{key_of(name)}.jpg", base64.b64decode(url.partition(",")[2]))

    def photos(self, scan_map: ScanMap) -> list[dict[str, Any]]:
        """Return the data of all photos of a scan for the page."""
        digest = scan_map.scan_sha256
        results = {n: r for n, r in list(self._results.items()) if r.source.cloud_sha256 == digest}
        shorts = site.shorten_names([name[MARK + 1 :] for name in results])
        return [
            self.photo(name, short, result, scan_map)
            for (name, result), short in zip(results.items(), shorts, strict=True)
        ]

    def photo(self, name: str, short: str, result: Result, scan_map: ScanMap) -> dict[str, Any]:
        """Return the data of a photo for the page."""
        key = key_of(name)
        thumb = f"{THUMBS}/{key}.jpg"
        entry = site.document_of_entry(site.Entry(result, None, 0.0), name, key, scan_map)
        has_thumb = (self.folder / thumb).exists()
        return {**entry, "short": short, "hasPictures": True, "thumb": thumb if has_thumb else None}

    def find(self, key: str) -> tuple[bytes, Result] | None:
        """Return the content and the result of the photo with a key; None if there is none."""
        for name, result in list(self._results.items()):
            if key_of(name) == key and (self.folder / name).exists():
                return (self.folder / name).read_bytes(), result
        return None

    def find_thumb(self, key: str) -> bytes | None:
        """Return the thumbnail of the photo with a key; None if there is none."""
        path = self.folder / THUMBS / f"{key}.jpg"
        return path.read_bytes() if site.KEY.fullmatch(key) and path.exists() else None


def key_of(name: str) -> str:
    """Return the key by which the page names a photo."""
    return sha256(name.encode(errors="surrogateescape")).hexdigest()[:32]


@contextmanager
def open_keep(folder: Path) -> Iterator[Keep]:
    """Open a folder and lock it for this process. Raise InputError if its results can't be read."""
    with open_locked(folder / RESULTS) as lines:
        yield Keep(folder, lines)
