"""An index made on an executor."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import tiny

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index

NAMES = [f"Town05_type001_subtype0001_scenario{number:05d}" for number in range(1, 6)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in NAMES:
        tiny.write_tiny_release(tmp_path / "release", name=name)
    return tmp_path / "release"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_executor_makes_the_same_bytes(root: Path) -> None:
    layout, whole, other = find_release(root, "v1"), root.parent / "whole", root.parent / "other"
    open_index(layout, index_dir=whole)
    with ThreadPoolExecutor(3) as threads:
        assert len(DeepAccident("v1", root, other, verbose=False, executor=threads).scenario) == len(NAMES)
    assert contents(other) == contents(whole)
