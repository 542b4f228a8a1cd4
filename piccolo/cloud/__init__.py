"""Point clouds: a reader for each format, then checks and an order common to all."""

from .stream import FORMATS, Cloud, CloudStream, open_cloud, open_source, read_cloud

__all__ = ["FORMATS", "Cloud", "CloudStream", "open_cloud", "open_source", "read_cloud"]
