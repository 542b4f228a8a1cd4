"""The files that a mesh names: its materials, textures and buffers."""

from dataclasses import dataclass, field
from pathlib import Path

from ...errors import InputError


@dataclass
class FolderResolver:
    """The files in a mesh's own folder and below, and nothing else; a resolver for trimesh.

    trimesh goes on without a file that it can't get, so the first refusal is kept for later.
    """

    path: Path  # the mesh
    refusal: InputError | None = None
    _contents: dict[Path, bytes] = field(default_factory=dict)

    @property
    def num_bytes(self) -> int:
        """Bytes of all files read so far."""
        return sum(map(len, self._contents.values()))

    def get(self, name: str) -> bytes:
        """The content of a file, by the name that the mesh gives it."""
        try:
            return self._content(name)
        except InputError as refusal:
            self.refusal = self.refusal or refusal
            raise

    __getitem__ = get

    def _content(self, name: str) -> bytes:
        folder, short = self.path.parent.resolve(), ascii(name[:100])
        try:
            file = (folder / name.strip().replace("\\", "/")).resolve()  # names may be written on Windows
            if ":" in name or not file.is_relative_to(folder):  # ':' of a drive or a URL
                raise InputError(
                    f"{self.path}: names the file {short}, wanted names in the mesh's own folder or below"
                )
            if not file.is_file():
                raise InputError(f"{self.path}: names the file {short}, which is not in its folder")
            if file not in self._contents:
                self._contents[file] = file.read_bytes()
        except InputError:
            raise
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{self.path}: names the file {short} ({error})") from error
        return self._contents[file]
