"""Copies in a folder of bounded size."""

import os
from pathlib import Path

from deepaccident_devkit.release.store.store import FileCache


def test_the_least_used_copies_go_first(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, 1000)
    paths = [cache.path_of(f"file {number}", "a.jpg") for number in range(12)]
    for number, path in enumerate(paths[:9]):
        cache.put(path, bytes(100))
        os.utime(path, ns=(number, number))
    assert cache.found(paths[0], 100)
    for path in paths[9:]:
        cache.put(path, bytes(100))
    there = [path.exists() for path in paths]
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.jpg")) <= 1000
    assert there[0]
    assert all(there[-2:])
    assert not all(there[1:4])


def test_a_file_larger_than_the_cache_is_kept_alone(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, 100)
    small, large = cache.path_of("small", "a"), cache.path_of("large", "a")
    cache.put(small, bytes(50))
    cache.put(large, bytes(500))
    assert large.exists()
    assert not small.exists()
