"""Point clouds: one reader a format, then the same checks and the same order for all."""

from .open import FORMATS, open_cloud, open_source, read_cloud
from .stream import Cloud, CloudStream, stream_points

__all__ = ["FORMATS", "Cloud", "CloudStream", "open_cloud", "open_source", "read_cloud", "stream_points"]
