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
        folder, problem = self.path.parent.resolve(), ""
        try:
            file = (folder / name.strip().replace("\\", "/")).resolve()  # names may be written on Windows
            if ":" in name or not file.is_relative_to(folder):  # ':' of a drive or a URL
                problem = ", wanted names in the mesh's own folder or below"
            elif not file.is_file():
                problem = ", which is not in its folder"
            elif file not in self._contents:
                self._contents[file] = file.read_bytes()
        except (OSError, ValueError, RuntimeError) as error:
            problem = f" ({error})"
        if problem:
            refusal = InputError(f"{self.path}: names the file {name[:100]!a}{problem}")
            self.refusal = self.refusal or refusal
            raise refusal
        return self._contents[file]

    __getitem__ = get
