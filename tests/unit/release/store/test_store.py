"""The same release in a folder, in zips and at URLs: every byte, every number and every verb."""

import os
import pickle
import shutil
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from packing import image_sum, packed
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import MissingFileError, NotAvailableError, SomeFailedError
from deepaccident_devkit.release.store import open_dataroot
from deepaccident_devkit.release.store.sources import LocalSource, UrlSource
from deepaccident_devkit.release.store.store import FileCache
from deepaccident_devkit.support.reading import RefusedFileError
from deepaccident_devkit.tables import clear_index
from deepaccident_devkit.taxonomy import CHANNELS

pytestmark = pytest.mark.slow

STORES = ("zip", "zips", "memory", "memory zips", "memory zip")
LOCAL_STORES = ("zip", "zips")


@pytest.mark.parametrize("kind", STORES)
def test_the_index_has_the_same_bytes(opened: dict[str, DeepAccident], kind: str) -> None:
    folder, other = opened["folder"].tables_folder, opened[kind].tables_folder
    assert [path.name for path in sorted(other.iterdir())] == [
        path.name for path in sorted(folder.iterdir())
    ]
    for path in folder.iterdir():
        assert (other / path.name).read_bytes() == path.read_bytes()
    assert opened[kind].split_scenarios("train") == opened["folder"].split_scenarios("train")


@pytest.mark.parametrize("kind", STORES)
def test_every_sensor_file_has_the_same_bytes(opened: dict[str, DeepAccident], kind: str) -> None:
    folder, other = opened["folder"], opened[kind]
    tokens = [f"{record['token']}/{channel}" for record in folder.sample for channel in CHANNELS][
        ::7
    ]
    for token in tokens:
        assert (
            other.local_path(token).read_bytes() == folder.get_sample_data_path(token).read_bytes()
        )
    assert other.sensor_frames(tokens[0].rsplit("/", 3)[0]) == folder.sensor_frames(
        folder.scenario[0]
    )
    sample = folder.sample[3]["token"]
    for read in (
        lambda da: da.load_image(sample, "Camera_Back"),
        lambda da: da.load_point_cloud(sample).xyz,
        lambda da: da.load_bev(sample).instance,
    ):
        assert np.array_equal(read(other), read(folder))


@pytest.mark.parametrize("kind", STORES)
def test_a_path_is_given_only_where_there_is_one(
    opened: dict[str, DeepAccident], kind: str
) -> None:
    dataset, token = opened[kind], opened[kind].sample[0]["token"]
    with pytest.raises(
        NotAvailableError, match=r"lies in an archive or at a URL; da\.local_path\(token\)"
    ):
        dataset.get_sample_data_path(token, "lidar01")
    path, boxes, _ = dataset.get_sample_data(token, "lidar01")
    assert path == dataset.local_path(token, "lidar01")
    assert path.name == opened["folder"].get_sample_data_path(token, "lidar01").name
    assert len(boxes) == len(opened["folder"].get_boxes(token))


def test_local_path_of_a_folder_is_the_file_itself(
    da_partial: DeepAccident, da: DeepAccident
) -> None:
    token = da.sample[0]["token"]
    assert da.local_path(token, "lidar01") == da.get_sample_data_path(token, "lidar01")
    absent = next(
        f"{record['token']}/{channel}"
        for record in da_partial.sample
        for channel in CHANNELS
        if not da_partial.get_sample_data_path(f"{record['token']}/{channel}").exists()
    )
    assert_refused((lambda: da_partial.local_path(absent), MissingFileError, "no such file"))


def test_a_file_that_no_archive_holds_is_missing(release_root: Path, tmp_path: Path) -> None:
    packed(release_root, tmp_path / "some.zip", chosen=lambda path: "lidar01" not in path.parts)
    dataset = DeepAccident(dataroot=tmp_path / "some.zip", workers=1, verbose=False)
    assert_refused(
        (
            lambda: dataset.load_point_cloud(dataset.sample[0]),
            MissingFileError,
            r"some\.zip/.*lidar01.*no such file",
        ),
        (
            lambda: dataset.local_path(dataset.sample[0], "lidar01"),
            MissingFileError,
            "no such file; add the archive that holds it",
        ),
    )


@pytest.mark.parametrize("kind", LOCAL_STORES)
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_workers_read_what_was_pickled(
    opened: dict[str, DeepAccident], kind: str, method: str
) -> None:
    dataset, token = opened[kind], opened[kind].sample[2]["token"]
    expected = image_sum(opened["folder"], token)
    assert image_sum(dataset, token) == expected  # the archive is open before the fork
    assert image_sum(pickle.loads(pickle.dumps(dataset)), token) == expected
    with ProcessPoolExecutor(2, mp_context=get_context(method)) as pool:
        assert list(pool.map(image_sum, [dataset] * 4, [token] * 4)) == [expected] * 4


def test_an_unpacked_release_counts_and_not_the_archives_beside_it(own_release: Path) -> None:
    packed(own_release, own_release / "left.zip")
    assert DeepAccident(dataroot=own_release, workers=1, verbose=False).dataroot == own_release


def test_a_new_archive_is_noticed(release_root: Path, tmp_path: Path) -> None:
    agents = [
        path.name
        for path in (release_root / "type1_subtype1_accident").iterdir()
        if path.name != "meta"
    ]
    folder, counts = tmp_path / "zips", []
    for agent in agents[:2]:
        packed(
            release_root,
            folder / f"{agent}.zip",
            chosen=lambda path, agent=agent: agent in path.parts,
        )
        counts.append(len(DeepAccident(dataroot=folder, workers=1, verbose=False).sample))
    assert counts[0] < counts[1]
    assert len(list((folder / ".deepaccident").glob("files-*"))) == 1


def test_as_many_archives_are_open_as_the_system_allows(
    places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepaccident_devkit.release.store.sources.MAX_OPEN_ARCHIVES", 2)
    folder = shutil.copytree(places["zips"], tmp_path / "zips")
    source, names = (
        LocalSource(folder),
        sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.zip")),
    )
    for name in names * 2:
        assert source.read(name, 0, 4) == b"PK\x03\x04"
        assert (
            sum(folder in file.resolve().parents for file in Path("/proc/self/fd").iterdir()) <= 2
        )


def test_clear_removes_the_lists_too(release_root: Path, tmp_path: Path) -> None:
    archive = packed(release_root, tmp_path / "all.zip")
    DeepAccident(dataroot=archive, workers=1, verbose=False)
    assert [folder.name for folder in clear_index(archive)] == ["v1"]
    open_dataroot(archive, workers=1)
    assert clear_index(archive) == []
    assert [each for each in (tmp_path / ".deepaccident").rglob("*") if each.is_file()] == []


def test_the_least_used_copies_go_first(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, 1000)
    paths = [cache.path_of(f"file {number}", "a.jpg") for number in range(12)]
    for number, path in enumerate(paths[:9]):
        cache.put(path, bytes(100))
        os.utime(path, ns=(number, number))
    assert cache.has_copy(paths[0], 100)
    for path in paths[9:]:
        cache.put(path, bytes(100))
    there = [path.exists() for path in paths]
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.jpg")) <= 1000
    assert (there[0], there[-2:], there[1:4] != [True] * 3) == (True, [True, True], True)


@pytest.mark.parametrize("kind", ["memory", "memory zips"])
def test_a_url_that_fails_amid_indexing_is_told(
    places: dict[str, str], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = Mock(side_effect=RefusedFileError(5, "cannot be read (the line is dead)"))
    monkeypatch.setattr(UrlSource, "read_all", gone)
    opening = partial(
        DeepAccident, dataroot=places[kind], index_dir=tmp_path, workers=1, verbose=False
    )
    named = ("memory://", ": cannot be read (the line is dead)", "check the connection")
    assert_refused((opening, SomeFailedError, named))
