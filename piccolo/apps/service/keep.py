"""A folder that keeps photos and their results, with which the page opens again."""

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
MARK = 12  # digits of a photo's digest, before its name
BEGINS = b'{"'


class Keep:
    """Photos, each under a name that no other has, and a file of their results."""

    def __init__(self, folder: Path, lines: LineFile) -> None:
        self.folder = folder
        self._lines = lines
        self._writing = Lock()
        lines.cut(whole_size(lines.path, BEGINS, "results"))
        found = read_results([lines.path]) if lines.size else []
        self._results = {Path(result.pano).name: result for result in found}

    def add(self, name: str, content: bytes, result: Result) -> str:
        """Keep a photo and its result, both or none; return its name here."""
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
        """Keep the thumbnail of a photo: JPEG, as an address that holds it."""
        thumbs = self.folder / THUMBS
        thumbs.mkdir(exist_ok=True)
        write_atomically(thumbs / f"{key_of(name)}.jpg", base64.b64decode(url.partition(",")[2]))

    def photos(self, scan_map: ScanMap) -> list[dict[str, Any]]:
        """Return what the page knows of the photos in a scan."""
        digest = scan_map.scan_sha256
        results = {n: r for n, r in list(self._results.items()) if r.source.cloud_sha256 == digest}
        shorts = site.shorten_names([name[MARK + 1 :] for name in results])
        return [
            self.photo(name, short, result, scan_map)
            for (name, result), short in zip(results.items(), shorts, strict=True)
        ]

    def photo(self, name: str, short: str, result: Result, scan_map: ScanMap) -> dict[str, Any]:
        """Return what the page knows of a photo."""
        key = key_of(name)
        thumb = f"{THUMBS}/{key}.jpg"
        entry = site.document_of_entry(site.Entry(result, None, 0.0), name, key, scan_map)
        has_thumb = (self.folder / thumb).exists()
        return {**entry, "short": short, "hasPictures": True, "thumb": thumb if has_thumb else None}

    def find(self, key: str) -> tuple[bytes, Result] | None:
        """Return the content of a photo and its result, by its key on the page."""
        for name, result in list(self._results.items()):
            if key_of(name) == key and (self.folder / name).exists():
                return (self.folder / name).read_bytes(), result
        return None

    def find_thumb(self, key: str) -> bytes | None:
        """Return the thumbnail of a photo."""
        path = self.folder / THUMBS / f"{key}.jpg"
        return path.read_bytes() if site.KEY.fullmatch(key) and path.exists() else None


def key_of(name: str) -> str:
    """Return the key of a photo on the page."""
    return sha256(name.encode(errors="surrogateescape")).hexdigest()[:32]


@contextmanager
def open_keep(folder: Path) -> Iterator[Keep]:
    """Open a folder that this process alone may write; InputError if its results can't be read."""
    with open_locked(folder / RESULTS) as lines:
        yield Keep(folder, lines)
