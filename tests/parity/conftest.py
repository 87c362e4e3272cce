"""Golden cases from the folder that `--golden` names.

A test marked `golden_cases(part, list)` runs once for each entry of that list in `<folder>/<part>.json` and takes the
fixture `golden`. Where the folder, the file or the list is missing or empty, it runs once, and fails.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@dataclass(frozen=True)
class GoldenCase:
    """One entry of a golden part; arrays by (name, further indices): `golden["xy", 3]` is `xy_<case>_3`."""

    folder: Path
    part: str
    key: str
    index: int | None

    def _checked_index(self) -> int:
        if self.index is None:
            pytest.fail(f"{self.folder / self.part}.json: no case in its list '{self.key}'; see pytest --golden DIR")
        return self.index

    @property
    def entry(self) -> Any:
        """What the part's JSON says of this case."""
        return _json(self.folder / f"{self.part}.json")[self.key][self._checked_index()]

    def __getitem__(self, name: str | tuple[str | int, ...]) -> np.ndarray:
        first, *rest = (name,) if isinstance(name, str) else name
        words = [str(first), f"{self._checked_index():02d}", *map(str, rest)]
        return _arrays(self.folder / f"{self.part}.npz")["_".join(words)]


@functools.cache
def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


@functools.cache
def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "golden_cases(part, list): one test an entry of that list in the part's JSON")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    marker = metafunc.definition.get_closest_marker("golden_cases")
    if marker is None:
        return
    part, key = marker.args
    folder = metafunc.config.getoption("golden")
    count = len(_json(folder / f"{part}.json").get(key, []))
    cases = [GoldenCase(folder, part, key, index) for index in range(count) or [None]]
    metafunc.parametrize("golden", cases, ids=lambda case: f"{part}-{case.index}")
