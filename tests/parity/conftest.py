"""Golden cases from the folder that `--golden` names.

A test marked `golden_cases(part, list)` runs once for each entry of that list in
`<folder>/<part>.json` and takes the fixture `golden`; one marked `golden_rows(part, array)` runs
once for each row of that array in `<folder>/<part>.npz` and takes `golden_row`. Where the folder,
the file, the list or the array is missing or empty, it runs once, and fails.
"""

import functools
import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.golden_model import GoldenModel

if importlib.util.find_spec("torch") is None:
    collect_ignore_glob = ["test_model*"]


@dataclass(frozen=True)
class GoldenCase:
    """One entry of a golden part, indexed by an array's name and further indices.

    `golden["xy", 3]` is the array `xy_<case>_3`.
    """

    folder: Path
    part: str
    key: str
    index: int | None

    def _checked_index(self) -> int:
        if self.index is None:
            pytest.fail(
                f"{self.folder / self.part}.json: no case in its list '{self.key}'; "
                f"see pytest --golden DIR"
            )
        return self.index

    @property
    def entry(self) -> Any:
        """Return the case's entry in the part's JSON file."""
        return _json(self.folder / f"{self.part}.json")[self.key][self._checked_index()]

    def __getitem__(self, name: str | tuple[str | int, ...]) -> np.ndarray:
        first, *rest = (name,) if isinstance(name, str) else name
        arrays = _arrays(self.folder / f"{self.part}.npz")
        index = self._checked_index()

        suffix = "".join(f"_{number}" for number in rest)
        long_name = f"{first}_{index:03d}{suffix}"
        if long_name in arrays:
            return arrays[long_name]
        return arrays[f"{first}_{index:02d}{suffix}"]

    @property
    def whole(self) -> dict[str, Any]:
        """Return the content of the part's JSON file."""
        return _json(self.folder / f"{self.part}.json")

    def array(self, name: str) -> np.ndarray:
        """Return an array of the part that belongs to no single case."""
        return _arrays(self.folder / f"{self.part}.npz")[name]


@dataclass(frozen=True)
class GoldenRow:
    """One case of a golden part that has a row a case in its arrays.

    `golden_row["ego_to_world"]` is this case's row of the array.
    """

    folder: Path
    part: str
    key: str
    index: int | None

    def __getitem__(self, name: str) -> np.ndarray:
        if self.index is None:
            pytest.fail(
                f"{self.folder / self.part}.npz: no row in its array '{self.key}'; "
                f"see pytest --golden DIR"
            )
        return _arrays(self.folder / f"{self.part}.npz")[name][self.index]


@functools.cache
def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


@functools.cache
def _arrays(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    with np.load(path) as archive:
        return dict(archive)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "golden_cases(part, list): one test an entry of that list in the part's JSON"
    )
    config.addinivalue_line(
        "markers", "golden_rows(part, array): one test a row of that array in the part's npz"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    folder = metafunc.config.getoption("golden")
    by_case = metafunc.definition.get_closest_marker("golden_cases")
    if by_case is not None:
        part, key = by_case.args
        count = len(_json(folder / f"{part}.json").get(key, []))
        cases = [GoldenCase(folder, part, key, index) for index in range(count) or [None]]
        metafunc.parametrize("golden", cases, ids=_name_case)
    by_row = metafunc.definition.get_closest_marker("golden_rows")
    if by_row is not None:
        part, key = by_row.args
        count = len(_arrays(folder / f"{part}.npz").get(key, []))
        rows = [GoldenRow(folder, part, key, index) for index in range(count) or [None]]
        metafunc.parametrize("golden_row", rows, ids=_name_case)


def _name_case(case: GoldenCase | GoldenRow) -> str:
    return f"{case.part}-{case.index}"


@pytest.fixture
def golden_model(request: pytest.FixtureRequest) -> Callable[[str], GoldenModel]:
    """Return a function that reads a golden part of the model by its name."""
    return functools.partial(GoldenModel, request.config.getoption("golden"))
