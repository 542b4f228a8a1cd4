"""The files that a mesh names: its materials, textures and buffers."""

import base64
import binascii
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

from ...errors import InputError

DATA_URI = "data:"


@dataclass
class Beside:
    """The files in a mesh's own folder and below, and nothing else; a resolver for trimesh.

    trimesh goes on without a file that can't be had, so the first refusal is kept for later.
    """

    path: Path  # the mesh
    in_memory: dict[str, bytes] = field(default_factory=dict)  # by name, made up for what has none
    refusal: InputError | None = None

    def get(self, name: str) -> bytes:
        """The content of a file, by the name that the mesh gives it."""
        if name in self.in_memory:
            return self.in_memory[name]
        try:
            content = self.in_memory[name] = self._content(name)
        except InputError as refusal:
            self.refusal = self.refusal or refusal
            raise
        return content

    __getitem__ = get

    def uri_content(self, uri: str) -> bytes:
        """The content behind a URI of glTF: base64 or the name of a file."""
        if not uri.startswith(DATA_URI):
            return self.get(unquote(uri))
        try:
            return base64.b64decode(uri.partition("base64,")[2], validate=True)
        except binascii.Error as error:
            raise InputError(f"{self.path}: broken base64 ({error}), wanted a whole mesh") from error

    def _content(self, name: str) -> bytes:
        relative = Path(name.strip().replace("\\", "/"))  # written on Windows
        folder = self.path.parent.resolve()
        has_drive = ":" in name  # a URL as well
        try:
            file = (folder / relative).resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{self.path}: names the file {_short(name)} ({error})") from error
        if has_drive or relative.is_absolute() or not file.is_relative_to(folder):
            raise InputError(
                f"{self.path}: names the file {_short(name)}, wanted names in the mesh's own folder or below"
            )
        try:
            is_file = file.is_file()
            content = file.read_bytes() if is_file else b""
        except (OSError, ValueError) as error:
            raise InputError(f"{self.path}: names the file {_short(name)} ({error})") from error
        if not is_file:
            raise InputError(f"{self.path}: names the file {_short(name)}, which is not in its folder")
        return content


def _short(name: str) -> str:
    return ascii(name[:100])
