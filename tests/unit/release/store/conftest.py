"""A release of the tests in a folder, in one zip, in several, and in fsspec's memory."""

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from support.zipped_releases import release_files, zip_agents, zip_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import AGENTS


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give this test its own folder of copies."""
    folder = tmp_path / "copies"
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(folder))
    return folder


@pytest.fixture(scope="session")
def dataroots(
    release_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, str]]:
    """Return the dataroot of each kind of store."""
    folder = tmp_path_factory.mktemp("stores")
    archive = zip_release(release_root, folder / "all.zip", "deflated", "DeepAccident/")
    zips = zip_agents(release_root, folder / "zips", (*AGENTS, "meta"))

    memory = fsspec.filesystem("memory")
    for path in release_files(release_root):
        name = path.relative_to(release_root).as_posix()
        memory.pipe_file(f"/loose/any/{name}", path.read_bytes())
    for path in release_files(zips):
        name = path.relative_to(zips).as_posix()
        memory.pipe_file(f"/packed/{name}", path.read_bytes())
    memory.pipe_file("/one/all.zip", archive.read_bytes())

    yield {
        "folder": str(release_root),
        "zip": str(archive),
        "zips": str(zips),
        "memory": "memory://loose",
        "memory zips": "memory://packed",
        "memory zip": "memory://one/all.zip",
    }
    memory.rm("/", recursive=True)


@pytest.fixture(scope="session")
def releases(
    dataroots: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, DeepAccident]:
    """Open the release in each kind of store, with its own index."""
    folder = tmp_path_factory.mktemp("indexes")
    return {
        kind: DeepAccident(dataroot=dataroot, index_dir=folder / kind, workers=1, verbose=False)
        for kind, dataroot in dataroots.items()
    }
