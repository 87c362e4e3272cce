"""What pages keep: values in memory within a bound, and thumbnails beside the index or in the user's cache."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Final, Generic, TypeVar

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.parallel import Store
from deepaccident_devkit.release.store.store import FileCache
from deepaccident_devkit.support.files import is_writable_folder, place_in

Value = TypeVar("Value")
_THUMBNAILS: Final = "thumbnails"


class Kept(Generic[Value]):
    """Values that are made when they are asked for the first time; those that were not asked for the longest go.

    Each is made once, also if several threads ask for it at the same time; other values are made meanwhile.
    """

    def __init__(self, most: float, size: Callable[[Value], float] = lambda _: 1.0) -> None:
        """Keep values as long as their sizes are at most so much in sum; by default so many values."""
        self._most, self._size = most, size
        self._values: OrderedDict[Hashable, Value] = OrderedDict()
        self._total = 0.0
        self._lock = threading.Lock()
        self._making: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key; raises what `make` raises, of which nothing is kept."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                if key in self._values:
                    return self._values[key]
            try:
                value = make()
                self._keep(key, value)
            finally:
                with self._lock:
                    self._making.pop(key, None)
        return value

    def _keep(self, key: Hashable, value: Value) -> None:
        with self._lock:
            self._values[key] = value
            self._total += self._size(value)
            while self._total > self._most and len(self._values) > 1:
                _, old = self._values.popitem(last=False)
                self._total -= self._size(old)


class KeptFiles:
    """Small files that are made once: beside the index, and where that cannot be written, in the user's cache."""

    def __init__(self, dataset: Dataset) -> None:
        """Take the release whose index they lie beside: they go when the tables are made again."""
        self.folder = place_in(dataset.tables_folder, _THUMBNAILS, opened=True)
        if not is_writable_folder(dataset.tables_folder):
            self.folder = FileCache.of_user().folder.with_name(_THUMBNAILS)
        self._store = Store(self.folder, self.folder, "keeps thumbnails", IndexStoreError)

    def get(self, identity: str, name: str, make: Callable[[], bytes]) -> bytes:
        """The content of a file; `identity` tells it from all others. Raises what `make` raises."""
        digest = hashlib.blake2b(identity.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        place = f"{digest[:2]}/{digest[2:]}/{name}"
        kept = self._store.kept(place, digest, "image")
        if kept is not None:
            return kept
        content = make()
        with suppress(OSError):  # no room, or a folder that may not be written to: it is made again the next time
            self._store.keep(place, digest, content)
        return content
