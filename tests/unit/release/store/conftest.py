"""A release of the tests' in a folder, in one zip, in several, and in fsspec's memory."""

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from packing import packed, packed_by_agent

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import AGENTS


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of copies of this test alone."""
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "copies"))
    return tmp_path / "copies"


@pytest.fixture(scope="session")
def places(
    release_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, str]]:
    """Kind of store → what to give as dataroot."""
    folder, memory = tmp_path_factory.mktemp("stores"), fsspec.filesystem("memory")
    places = {
        "folder": str(release_root),
        "zip": str(packed(release_root, folder / "all.zip", "deflated", "DeepAccident/")),
        "zips": str(packed_by_agent(release_root, folder / "zips", (*AGENTS, "meta"))),
    }
    for path in release_root.rglob("*"):
        if path.is_file() and ".deepaccident" not in path.parts:
            memory.pipe_file(
                f"/loose/any/{path.relative_to(release_root).as_posix()}", path.read_bytes()
            )
    for path in Path(places["zips"]).rglob("*.*"):
        if path.is_file():
            memory.pipe_file(
                f"/packed/{path.relative_to(places['zips']).as_posix()}", path.read_bytes()
            )
    memory.pipe_file("/one/all.zip", Path(places["zip"]).read_bytes())
    yield {
        **places,
        "memory": "memory://loose",
        "memory zips": "memory://packed",
        "memory zip": "memory://one/all.zip",
    }
    memory.rm("/", recursive=True)


@pytest.fixture(scope="session")
def opened(
    places: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, DeepAccident]:
    """Kind of store → the release, each with an index of its own."""
    folder = tmp_path_factory.mktemp("indexes")
    return {
        kind: DeepAccident(dataroot=place, index_dir=folder / kind, workers=1, verbose=False)
        for kind, place in places.items()
    }
