"""Values that a reader returns are found with their names, whatever form it returns them in."""

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
NamedRow = namedtuple("NamedRow", "ttc length")


@dataclass
class RowRecord:
    ttc: float
    length: float


@dataclass(slots=True)
class SlottedRecord:
    ttc: float


@dataclass(slots=True)
class DerivedRecord(SlottedRecord):
    length: float


class RowObject:
    def __init__(self, ttc: float, length: float) -> None:
        self.ttc = ttc
        self.length = length


class IterableDataset:
    """An object that has state and yields rows."""

    def __init__(self) -> None:
        self.root = "somewhere"

    def __iter__(self) -> Iterator[Any]:
        return iter(ROWS)


class IndexedDataset:
    """A dataset for training, which has a length and items."""

    def __len__(self) -> int:
        return len(ROWS)

    def __getitem__(self, index: int) -> Any:
        return ROWS[index]


class GpuTensor:
    """A tensor that NumPy cannot convert, as if on a GPU or with gradients."""

    def __init__(self, values: list[float]) -> None:
        self._values = values

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("use Tensor.cpu() first")

    def tolist(self) -> list[float]:
        return self._values


class SparseTensor(GpuTensor):
    def tolist(self) -> list[float]:
        raise RuntimeError("no storage")


def column(name: str) -> list[float]:
    return [row[name] for row in ROWS]


def structured_array() -> Any:
    rows = [tuple(row.values()) for row in ROWS]
    return np.array(rows, dtype=[("ttc", "f8"), ("length", "f8")])


def collect_values(value: Any) -> dict[str, list[Any]]:
    """Collect the values by the last name of their key."""
    values: dict[str, list[Any]] = {}
    for keys, leaf in itertools.islice(values_in(value, {}, [""]), 1000):
        if keys:
            names = [word for word in keys[0].split("/") if word != "*"]
            values.setdefault(names[-1], []).append(leaf)
    return values


@pytest.mark.parametrize(
    "make_value",
    [
        lambda: ROWS,
        lambda: tuple(ROWS),
        lambda: deque(ROWS),
        lambda: {"annotations": {f"token{number:04d}": row for number, row in enumerate(ROWS)}},
        lambda: (row for row in ROWS),
        lambda: map(dict, ROWS),
        lambda: [NamedRow(**row) for row in ROWS],
        lambda: [RowRecord(**row) for row in ROWS],
        lambda: [DerivedRecord(**row) for row in ROWS],
        lambda: [RowObject(**row) for row in ROWS],
        lambda: {row["ttc"]: RowObject(**row) for row in ROWS},
        IterableDataset,
        IndexedDataset,
        structured_array,
        lambda: list(structured_array()),
        lambda: structured_array().view(np.recarray),
        lambda: np.array(ROWS, dtype=object),
        lambda: {name: np.array(column(name)) for name in ROWS[0]},
        lambda: {name: GpuTensor(column(name)) for name in ROWS[0]},
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
        lambda: [{"frame": pa.Table.from_pylist(ROWS[:1])}, (NamedRow(**row) for row in ROWS[1:])],
    ],
)
def test_names_of_columns_fields_and_attributes_are_known(make_value: Callable[[], Any]) -> None:
    values = collect_values(make_value())
    assert values["ttc"] == column("ttc")
    assert values["length"] == column("length")


def test_words_numbers_and_what_is_masked_are_values() -> None:
    masked = np.ma.masked_array([1.0, 2.0], mask=[False, True])
    values = [masked, b"12", "13", Decimal("14.5"), np.float32(15), None, True, 10**5000]
    byte_words = np.array(["12"], "S")
    assert collect_values({"ttc": values})["ttc"] == [1.0, None, *values[1:]]
    assert collect_values({"ttc": byte_words}) == {"ttc": [b"12"]}


def test_components_and_rows_have_keys() -> None:
    unique_keys: dict[str, None] = {}
    for keys, _ in values_in({"center": np.zeros((2, 3))}, {}, [""]):
        unique_keys.update(dict.fromkeys(keys))
    assert [*unique_keys][:3] == ["/center/*/*", "/center/*/*[0]", "/center/*[0]/*"]
    assert len(unique_keys) == 1 + 3 + 2


class Kind(Enum):
    CAR = 1


@pytest.mark.parametrize("value", [object(), len, np, Kind, 1 + 2j, range, SparseTensor([])])
def test_an_object_without_parts_is_one_value(value: Any) -> None:
    leaves = [leaf for _, leaf in values_in([value], {}, [""])]
    assert leaves[-1] is not None


@pytest.mark.parametrize(
    "value",
    [
        itertools.cycle(ROWS),
        ({} for _ in itertools.count()),
        ([[]] for _ in itertools.count()),
        (IndexedDataset() for _ in itertools.count()),
        iter(lambda: iter(itertools.count, None), 0),
    ],
)
def test_endless_values_are_walked_step_by_step(value: Any) -> None:
    leaves = values_in(value, {}, [""])
    assert len([*itertools.islice(leaves, 5000)]) == 5000


def test_cyclic_and_deeply_nested_values_end() -> None:
    mapping: dict[str, Any] = {"ttc": column("ttc")}
    mapping["self"] = mapping
    cyclic: list[Any] = [mapping]
    cyclic.append(cyclic)
    assert collect_values(cyclic)["ttc"][:2] == column("ttc")
    deep: list[Any] = []
    for _ in range(sys.getrecursionlimit() * 2):
        deep = [deep]
    assert len([*values_in(deep, {}, [""])]) < 100


def test_errors_of_iterators_are_not_swallowed() -> None:
    def fail_after_one() -> Iterator[int]:
        yield 1
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(values_in([fail_after_one()], {}, [""]))


def test_files_in_a_folder_are_read_or_named(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "boxes.json").write_text('{"ttc": 12}')
    (tmp_path / "boxes.json").write_text('[{"ttc": NaN}]')
    (tmp_path / "evil.pkl").write_bytes(b"cos\nsystem\n(S'exit 1'\ntR.")
    values = [(keys[0], value) for keys, value in values_in_folder(tmp_path) if keys]
    assert values[1:3] == [("/boxes/ttc", 12), ("evil.pkl", tmp_path / "evil.pkl")]
    (tmp_path / "rows.json").write_text('{"ttc": 13}\n{"ttc"')
    with pytest.raises(ConfigError, match=r"rows\.json: is not JSON"):
        list(values_in_folder(tmp_path))
