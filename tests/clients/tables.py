"""Opens the exports of make_tables.py with datasets, Polars, DuckDB, pandas and webdataset; knows
no devkit.

Runs the code of docs/exports.md, too, that is marked with one of these names.
"""

import hashlib
import io
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

_CACHE = tempfile.TemporaryDirectory()
os.environ.update(HF_HOME=_CACHE.name, HF_HUB_OFFLINE="1", HF_DATASETS_DISABLE_PROGRESS_BARS="1")

import datasets  # noqa: E402 - which reads the variables once
import duckdb  # noqa: E402
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
import polars as pl  # noqa: E402
import webdataset as wds  # noqa: E402

PAGE = Path(__file__).parents[2] / "docs" / "exports.md"
CLIENTS = ("datasets", "duckdb", "polars", "pandas", "webdataset")
Rows = tuple[int, Callable[[int], dict[str, Any]]]


def files(table: str, split: str) -> list[str]:
    once = table in ("sensor", "category")
    return sorted(map(str, Path("out/tables", table).glob(f"{'all' if once else split}-*.parquet")))


def by_datasets(table: str, split: str) -> Rows:
    found = datasets.load_dataset("out/tables", table, split=split)
    return len(found), lambda row: found[row]


def by_polars(table: str, split: str) -> Rows:
    found = pl.read_parquet(files(table, split))
    return len(found), lambda row: found.row(row, named=True)


def by_duckdb(table: str, split: str) -> Rows:
    found = duckdb.read_parquet(files(table, split))
    return len(found), lambda row: dict(
        zip(found.columns, found.limit(1, row).fetchall()[0], strict=True)
    )


def by_pandas(table: str, split: str) -> Rows:
    found = pd.concat(map(pd.read_parquet, files(table, split)), ignore_index=True)
    return len(found), lambda row: found.iloc[row].to_dict()


def same(found: Any, told: Any) -> bool:
    """Whether values are equal; NaN is null."""
    if isinstance(told, dict):
        return all(same(found[name], value) for name, value in told.items())
    if isinstance(told, list):
        return len(found) == len(told) and all(map(same, found, told))
    return bool(found == told) if told is not None else found is None or math.isnan(found)


def check_tables(tables: dict[str, Any]) -> int:
    compared = 0
    for table, splits in tables.items():
        for split, told in splits.items():
            for opened in (by_datasets, by_polars, by_duckdb, by_pandas):
                count, row = opened(table, split)
                assert count == told["rows"], (opened, table, split, count)
                for at, record in told["some"].items():
                    assert same(row(int(at)), record), (opened, table, split, row(int(at)), record)
                    compared += 1
    return compared


def check_queries(told: dict[str, Any]) -> int:
    """Run the page's code; some of its blocks leave what it must find under these names."""
    blocks = re.findall(
        rf"^```python ({'|'.join(CLIENTS)})\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    assert {client for client, _ in blocks} == set(CLIENTS)
    names: dict[str, Any] = {}
    for client, code in blocks:
        with redirect_stdout(io.StringIO()):
            exec(compile(code, f"{PAGE.name}: {client}", "exec"), names)  # noqa: S102
    assert [list(row) for row in names["boxes"].fetchall()] == told["boxes"]
    assert sorted(names["impacts"]["token"]) == told["impacts"]
    assert sorted(map(list, names["hidden"])) == told["hidden"]
    return len(blocks)


def check_sample(sample: dict[str, Any], told: dict[str, Any], images: tuple[Any, Any]) -> None:
    points, facts = np.array(sample["lidar.npy"], dtype=np.float32), sample["json"]
    assert points.shape == (told["count"], 4)
    assert digest(points.tobytes()) == told["points"]
    assert [None if image is None else digest(image) for image in images] == [
        told["front"],
        told["back"],
    ]
    world_from_lidar = np.array(facts["world_from_ego"]) @ facts["ego_from_lidar"]
    assert np.allclose(world_from_lidar, told["world_from_lidar"], atol=1e-9)
    boxes = facts["boxes"]
    centers = np.array(boxes["center"]).reshape(-1, 3)
    assert np.allclose(
        centers @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3],
        np.reshape(told["centers"], (-1, 3)),
    )
    assert same(boxes["velocity"], told["velocities"])
    assert len({len(column) for column in boxes.values()}) == 1
    assert facts["cameras"]["camera_back_left"]["intrinsic"] == told["intrinsic"]
    assert facts["time_to_impact"] == told["time_to_impact"]


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def by_webdataset(split: str) -> Iterator[tuple[dict[str, Any], tuple[Any, Any]]]:
    paths = sorted(map(str, Path("out/shards").glob(f"{split}-*.tar")))
    raw = iter(wds.WebDataset(paths, shardshuffle=False))
    for sample in wds.WebDataset(paths, shardshuffle=False).decode("rgb8"):
        undecoded = next(raw)
        assert sample["camera_back_left.jpg"].shape == (36, 64, 3)
        yield sample, (undecoded.get("camera_front.jpg"), undecoded["camera_back_left.jpg"])


def shards_by_datasets(split: str) -> Iterator[tuple[dict[str, Any], tuple[Any, Any]]]:
    found = datasets.load_dataset("out/shards", split=split)
    assert found[0]["camera_back_left.jpg"].size == (64, 36)
    images = ("camera_front.jpg", "camera_back_left.jpg")
    for name in images:
        found = found.cast_column(name, datasets.Image(decode=False))
    for sample in found:
        yield sample, tuple(sample[name] and sample[name]["bytes"] for name in images)


def check_shards(told: dict[str, Any]) -> int:
    compared = 0
    for split, samples in told.items():
        for opened in (by_webdataset, shards_by_datasets):
            keys = []
            for sample, images in opened(split):
                keys.append(sample["__key__"])
                check_sample(sample, samples[keys[-1]], images)
            assert sorted(keys) == sorted(samples)
            moments = [(*key.split("/")[:2], key.split("/")[3]) for key in keys]
            assert moments == sorted(moments)
            compared += len(keys)
    return compared


def main(folder: Path) -> None:
    os.chdir(folder)
    expected = json.loads(Path("expected.json").read_text())
    print(
        f"tables: {check_tables(expected['tables'])} rows, "
        f"{check_queries(expected['queries'])} blocks of code and "
        f"{check_shards(expected['shards'])} samples in shards good"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
