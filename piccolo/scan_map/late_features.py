"""The local features of a map, made when a photo first needs them: many photos never do."""

import threading
from collections.abc import Callable

from ..jobs.threads import Workers
from ..local_features.feature_map import FeatureMap


class LateFeatures:
    """Local features that are made once; threads that ask meanwhile wait."""

    def __init__(self, make: Callable[[Workers], FeatureMap]) -> None:
        self._make = make
        self._look: Callable[[], FeatureMap | None] = lambda: None
        self._keep: Callable[[FeatureMap], None] = lambda features: None
        self._made: FeatureMap | None = None
        self._lock = threading.Lock()

    def keep_by(self, look: Callable[[], FeatureMap | None], keep: Callable[[FeatureMap], None]) -> None:
        """Look first for what another process has kept; keep what is made."""
        self._look = look
        self._keep = keep

    def get(self, workers: Workers) -> FeatureMap:
        """The features, made now if nobody has."""
        with self._lock:
            if self._made is None:
                self._made = self._look()
            if self._made is None:
                self._made = self._make(workers)
                self._keep(self._made)
            return self._made
