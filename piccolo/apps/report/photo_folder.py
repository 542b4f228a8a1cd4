"""The photos of results: found by their paths, also in another folder, and checked by their digests."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ...api.values import Result, photo_of
from ...photo.panorama.facts import sha256_of
from ...system.errors import InputError
from .drawings import FRAME


@dataclass(frozen=True)
class PhotoFolder:
    """The place of the photos: a folder, or where the results say if that is None."""

    path: Path | None = None

    @cached_property
    def by_name(self) -> dict[str, list[Path]]:
        """All that lies in the folder and below, by its name."""
        found: dict[str, list[Path]] = defaultdict(list)
        for path in sorted(self.path.rglob("*")) if self.path else ():
            found[path.name].append(path)
        return found

    def find(self, result: Result) -> tuple[Path, str]:
        """Return the path of a result's photo and its digest; InputError if only another photo is there.

        The digest is empty for a frame of a video, which is not checked, and for a photo that is not there,
        whose path is where it would be.
        """
        frame = FRAME.fullmatch(result.pano)
        if frame:
            places = self.list_places(frame["video"])
            video = next((path for path in places if path.is_file()), self.guess(frame["video"]))
            return Path(f"{video}#t={frame['time']}"), ""
        wanted = result.source.pano_sha256
        other = None
        for path in self.list_places(result.pano):
            digest = sha256_of(path, photo_of(result, path).instant)
            if digest and wanted in (None, digest):
                return path, digest
            other = other or (path if digest else None)
        if other is not None:
            raise InputError(
                f"{other}: no pictures of it, as it is not the photo of this result (its SHA-256)"
            )
        return self.guess(result.pano), ""

    def guess(self, pano: str) -> Path:
        """Return where a photo would be."""
        return Path(pano) if self.path is None else self.path / Path(pano).name

    def list_places(self, pano: str) -> Iterator[Path]:
        """Yield where a photo may be: below the folder with as much of its path as fits, then anywhere."""
        if self.path is None:
            yield Path(pano)
            return
        parts = [part for part in Path(pano).parts if part != Path(pano).anchor]
        first = max((k + 1 for k, part in enumerate(parts) if part == ".."), default=0)
        yield from (self.path.joinpath(*parts[k:]) for k in range(first, len(parts)))
        yield from self.by_name.get(Path(pano).name, [])
