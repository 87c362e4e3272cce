"""Compare the same release in a folder, in zips and at URLs: every byte, every number and every
verb.
"""

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
from support.expected_errors import assert_raises
from support.tiny_release_index import folder_contents
from support.zipped_releases import image_sum, zip_release

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
def test_the_index_has_the_same_bytes(releases: dict[str, DeepAccident], kind: str) -> None:
    expected = releases["folder"]
    release = releases[kind]
    assert folder_contents(release.tables_folder) == folder_contents(expected.tables_folder)
    assert release.split_scenarios("train") == expected.split_scenarios("train")


@pytest.mark.parametrize("kind", STORES)
def test_every_sensor_file_has_the_same_bytes(releases: dict[str, DeepAccident], kind: str) -> None:
    expected = releases["folder"]
    release = releases[kind]
    tokens = [f"{record['token']}/{channel}" for record in expected.sample for channel in CHANNELS]
    for token in tokens[::7]:
        content = expected.get_sample_data_path(token).read_bytes()
        assert release.local_path(token).read_bytes() == content

    scenario = expected.scenario[0]
    assert release.sensor_frames(scenario["token"]) == expected.sensor_frames(scenario)

    sample = expected.sample[3]["token"]
    for load in (
        lambda da: da.load_image(sample, "Camera_Back"),
        lambda da: da.load_point_cloud(sample).xyz,
        lambda da: da.load_bev(sample).instance,
    ):
        assert np.array_equal(load(release), load(expected))


@pytest.mark.parametrize("kind", STORES)
def test_a_path_is_given_only_where_there_is_one(
    releases: dict[str, DeepAccident], kind: str
) -> None:
    dataset = releases[kind]
    token = dataset.sample[0]["token"]
    with pytest.raises(
        NotAvailableError, match=r"is in an archive or at a URL; da\.local_path\(token\)"
    ):
        dataset.get_sample_data_path(token, "lidar01")

    path, boxes, _ = dataset.get_sample_data(token, "lidar01")
    assert path == dataset.local_path(token, "lidar01")
    assert path.name == releases["folder"].get_sample_data_path(token, "lidar01").name
    assert len(boxes) == len(releases["folder"].get_boxes(token))


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
    assert_raises((lambda: da_partial.local_path(absent), MissingFileError, "no such file"))


def test_a_file_that_no_archive_holds_is_missing(release_root: Path, tmp_path: Path) -> None:
    archive = zip_release(
        release_root, tmp_path / "some.zip", includes=lambda path: "lidar01" not in path.parts
    )
    dataset = DeepAccident(dataroot=archive, workers=1, verbose=False)
    assert_raises(
        (
            lambda: dataset.load_point_cloud(dataset.sample[0]),
            MissingFileError,
            r"some\.zip/.*lidar01.*no such file",
        ),
        (
            lambda: dataset.local_path(dataset.sample[0], "lidar01"),
            MissingFileError,
            "no such file; add the archive that contains it",
        ),
    )


@pytest.mark.parametrize("kind", LOCAL_STORES)
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_workers_read_what_was_pickled(
    releases: dict[str, DeepAccident], kind: str, method: str
) -> None:
    dataset = releases[kind]
    token = dataset.sample[2]["token"]
    expected = image_sum(releases["folder"], token)
    assert image_sum(dataset, token) == expected  # the archive is open before the fork

    copy = pickle.loads(pickle.dumps(dataset))
    assert image_sum(copy, token) == expected

    with ProcessPoolExecutor(2, mp_context=get_context(method)) as pool:
        sums = list(pool.map(image_sum, [dataset] * 4, [token] * 4))
    assert sums == [expected] * 4


def test_an_unpacked_release_counts_and_not_the_archives_beside_it(own_release: Path) -> None:
    zip_release(own_release, own_release / "left.zip")
    release = DeepAccident(dataroot=own_release, workers=1, verbose=False)
    assert release.dataroot == own_release


def test_a_new_archive_is_noticed(release_root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "zips"
    agents = [path.name for path in (release_root / "type1_subtype1_accident").iterdir()]
    agents.remove("meta")
    sample_counts = []
    for agent in agents[:2]:
        zip_release(
            release_root,
            folder / f"{agent}.zip",
            includes=lambda path, agent=agent: agent in path.parts,
        )
        release = DeepAccident(dataroot=folder, workers=1, verbose=False)
        sample_counts.append(len(release.sample))

    assert sample_counts[0] < sample_counts[1]
    assert len(list((folder / ".deepaccident").glob("files-*"))) == 1


def test_no_more_archives_are_open_than_the_limit(
    dataroots: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepaccident_devkit.release.store.sources.MAX_OPEN_ARCHIVES", 2)
    folder = shutil.copytree(dataroots["zips"], tmp_path / "zips")
    source = LocalSource(folder)
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.zip"))
    for name in names * 2:
        assert source.read(name, 0, 4) == b"PK\x03\x04"
        open_paths = [link.resolve() for link in Path("/proc/self/fd").iterdir()]
        assert sum(folder in path.parents for path in open_paths) <= 2


def test_clear_removes_the_lists_too(release_root: Path, tmp_path: Path) -> None:
    archive = zip_release(release_root, tmp_path / "all.zip")
    DeepAccident(dataroot=archive, workers=1, verbose=False)
    assert [folder.name for folder in clear_index(archive)] == ["v1"]

    open_dataroot(archive, workers=1)
    assert clear_index(archive) == []
    assert folder_contents(tmp_path / ".deepaccident") == {}


def test_the_least_recently_used_copies_are_evicted_first(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, 1000)
    paths = [cache.path_of(f"file {number}", "a.jpg") for number in range(12)]
    for number, path in enumerate(paths[:9]):
        cache.put(path, bytes(100))
        os.utime(path, ns=(number, number))
    assert cache.has_copy(paths[0], 100)

    for path in paths[9:]:
        cache.put(path, bytes(100))

    assert sum(path.stat().st_size for path in tmp_path.rglob("*.jpg")) <= 1000
    assert paths[0].exists()
    assert paths[-2].exists()
    assert paths[-1].exists()
    assert not all(path.exists() for path in paths[1:4])


@pytest.mark.parametrize("kind", ["memory", "memory zips"])
def test_a_url_that_fails_during_indexing_is_reported(
    dataroots: dict[str, str], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail = Mock(side_effect=RefusedFileError(5, "cannot be read (the line is dead)"))
    monkeypatch.setattr(UrlSource, "read_all", fail)
    open_release = partial(
        DeepAccident, dataroot=dataroots[kind], index_dir=tmp_path, workers=1, verbose=False
    )
    words = ("memory://", ": cannot be read (the line is dead)", "check the connection")
    assert_raises((open_release, SomeFailedError, words))
