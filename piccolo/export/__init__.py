"""Results as files of other tools: a writer for each format, and the same checks for all."""

from .formats import FORMATS, export
from .posed_images import Format, Options, Selection, select

__all__ = ["FORMATS", "Format", "Options", "Selection", "export", "select"]
