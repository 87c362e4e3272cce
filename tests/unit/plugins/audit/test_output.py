"""What readers return is walked through with its names, whatever its form."""

import itertools
import sys
from collections import deque, namedtuple
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.audit.output import values_in, values_in_folder

ROWS = [{"ttc": 2103.0, "length": 4.5}, {"ttc": 2110.0, "length": 4.6}]
Named = namedtuple("Named", "ttc length")


@dataclass
class Plain:
    ttc: float
    length: float


@dataclass(slots=True)
class Slotted:
    ttc: float


@dataclass(slots=True)
class Derived(Slotted):
    length: float


class Attributes:
    def __init__(self, ttc: float, length: float) -> None:
        self.ttc, self.length = ttc, length


class Iterable:
    """An object with state, and rows."""

    def __init__(self) -> None:
        self.root = "somewhere"

    def __iter__(self) -> Iterator[Any]:
        return iter(ROWS)


class Sequence:
    """As datasets for training are."""

    def __len__(self) -> int:
        return len(ROWS)

    def __getitem__(self, place: int) -> Any:
        return ROWS[place]


class Tensor:
    """On a GPU, or with gradients."""

    def __init__(self, values: list[float]) -> None:
        self._values = values

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("use Tensor.cpu() first")

    def tolist(self) -> list[float]:
        return self._values


class Sparse(Tensor):
    def tolist(self) -> list[float]:
        raise RuntimeError("no storage")


def column(name: str) -> list[float]:
    return [row[name] for row in ROWS]


def records() -> Any:
    return np.array([tuple(row.values()) for row in ROWS], dtype=[("ttc", "f8"), ("length", "f8")])


def found(value: Any) -> dict[str, list[Any]]:
    """The values of each key's last name."""
    numbers: dict[str, list[Any]] = {}
    for keys, leaf in itertools.islice(values_in(value, {}, [""]), 1000):
        if keys:
            name = [word for word in keys[0].split("/") if word != "*"][-1]
            numbers.setdefault(name, []).append(leaf)
    return numbers


@pytest.mark.parametrize(
    "made",
    [
        lambda: ROWS,
        lambda: tuple(ROWS),
        lambda: deque(ROWS),
        lambda: {"annotations": {f"token{number:04d}": row for number, row in enumerate(ROWS)}},
        lambda: (row for row in ROWS),
        lambda: map(dict, ROWS),
        lambda: [Named(**row) for row in ROWS],
        lambda: [Plain(**row) for row in ROWS],
        lambda: [Derived(**row) for row in ROWS],
        lambda: [Attributes(**row) for row in ROWS],
        lambda: {row["ttc"]: Attributes(**row) for row in ROWS},
        Iterable,
        Sequence,
        records,
        lambda: list(records()),
        lambda: records().view(np.recarray),
        lambda: np.array(ROWS, dtype=object),
        lambda: {name: np.array(column(name)) for name in ROWS[0]},
        lambda: {name: Tensor(column(name)) for name in ROWS[0]},
        lambda: [{name: np.array(value) for name, value in row.items()} for row in ROWS],
        lambda: pa.Table.from_pylist(ROWS),
        lambda: pa.Table.from_pylist(ROWS).to_batches(),
        lambda: pa.array(ROWS),
        lambda: dict(zip(ROWS[0], pa.Table.from_pylist(ROWS).columns, strict=True)),
        lambda: pytest.importorskip("pandas").DataFrame(ROWS),
        lambda: [row for _, row in pytest.importorskip("pandas").DataFrame(ROWS).iterrows()],
        lambda: {
            name: pytest.importorskip("pandas").Series(column(name), index=["a", "b"])
            for name in ROWS[0]
        },
        lambda: pytest.importorskip("polars").DataFrame(ROWS),
        lambda: {
            "ttc": pytest.importorskip("polars").Series(column("ttc")),
            "length": iter(column("length")),
        },
        lambda: [{"frame": pa.Table.from_pylist(ROWS[:1])}, (Named(**row) for row in ROWS[1:])],
    ],
)
def test_names_of_columns_fields_and_attributes_are_known(made: Callable[[], Any]) -> None:
    numbers = found(made())
    assert {name: numbers[name] for name in ROWS[0]} == {name: column(name) for name in ROWS[0]}


def test_words_numbers_and_what_is_masked_are_values() -> None:
    masked = np.ma.masked_array([1.0, 2.0], mask=[False, True])
    values = [masked, b"12", "13", Decimal("14.5"), np.float32(15), None, True, 10**5000]
    assert found({"ttc": values})["ttc"] == [1.0, None, *values[1:]]
    assert found({"ttc": np.array(["12"], "S")}) == {"ttc": [b"12"]}


def test_components_and_rows_have_keys() -> None:
    keys = dict.fromkeys(
        key for keys, _ in values_in({"center": np.zeros((2, 3))}, {}, [""]) for key in keys
    )
    assert [*keys][:3] == ["/center/*/*", "/center/*/*[0]", "/center/*[0]/*"]
    assert len(keys) == 1 + 3 + 2


class Kind(Enum):
    CAR = 1


@pytest.mark.parametrize("value", [object(), len, np, Kind, 1 + 2j, range, Sparse([])])
def test_what_has_no_parts_is_one_value(value: Any) -> None:
    assert [leaf for _, leaf in values_in([value], {}, [""])][-1] is not None


@pytest.mark.parametrize(
    "value",
    [
        itertools.cycle(ROWS),
        ({} for _ in itertools.count()),
        ([[]] for _ in itertools.count()),
        (Sequence() for _ in itertools.count()),
        iter(lambda: iter(itertools.count, None), 0),
    ],
)
def test_what_has_no_end_goes_on_step_by_step(value: Any) -> None:
    assert len([*itertools.islice(values_in(value, {}, [""]), 5000)]) == 5000


def test_what_holds_itself_ends() -> None:
    within: dict[str, Any] = {"ttc": column("ttc")}
    within["self"] = within
    turned: list[Any] = [within]
    turned.append(turned)
    assert found(turned)["ttc"][:2] == column("ttc")
    deep: list[Any] = []
    for _ in range(sys.getrecursionlimit() * 2):
        deep = [deep]
    assert len([*values_in(deep, {}, [""])]) < 100


def test_errors_of_iterators_come_through() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(values_in([broken()], {}, [""]))


def test_files_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "boxes.json").write_text('{"ttc": 12}')
    (tmp_path / "boxes.json").write_text('[{"ttc": NaN}]')
    (tmp_path / "evil.pkl").write_bytes(b"cos\nsystem\n(S'exit 1'\ntR.")
    keys = [(keys[0], value) for keys, value in values_in_folder(tmp_path) if keys]
    assert keys[1:3] == [("/boxes/ttc", 12), ("evil.pkl", tmp_path / "evil.pkl")]
    (tmp_path / "rows.json").write_text('{"ttc": 13}\n{"ttc"')
    with pytest.raises(ConfigError, match=r"rows\.json: is no JSON"):
        list(values_in_folder(tmp_path))
