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
from click.testing import CliRunner
from packing import files_of, image_sum, packed
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingFileError, NotAvailableError, SomeFailedError
from deepaccident_devkit.release.fingerprints import scenario_hashes
from deepaccident_devkit.release.store import open_dataroot
from deepaccident_devkit.release.store.sources import LocalSource, UrlSource
from deepaccident_devkit.release.store.store import FileCache
from deepaccident_devkit.support.reading import RefusedFileError
from deepaccident_devkit.tables import clear_index
from deepaccident_devkit.taxonomy import CHANNELS
from deepaccident_devkit.validation import release_completeness, validate_release

STORES = ("zip", "zips", "memory", "memory zips", "memory zip")
LOCAL_STORES = ("zip", "zips")


@pytest.mark.parametrize("kind", STORES)
def test_the_index_has_the_same_bytes(opened: dict[str, DeepAccident], kind: str) -> None:
    folder, other = opened["folder"].tables_folder, opened[kind].tables_folder
    assert [path.name for path in sorted(other.iterdir())] == [path.name for path in sorted(folder.iterdir())]
    for path in folder.iterdir():
        assert (other / path.name).read_bytes() == path.read_bytes()
    assert opened[kind].split_scenarios("train") == opened["folder"].split_scenarios("train")


@pytest.mark.parametrize("kind", STORES)
def test_every_sensor_file_has_the_same_bytes(opened: dict[str, DeepAccident], kind: str) -> None:
    folder, other = opened["folder"], opened[kind]
    tokens = [f"{record['token']}/{channel}" for record in folder.sample for channel in CHANNELS][::7]
    for token in tokens:
        assert other.local_path(token).read_bytes() == folder.get_sample_data_path(token).read_bytes()
    assert other.sensor_frames(tokens[0].rsplit("/", 3)[0]) == folder.sensor_frames(folder.scenario[0])
    sample = folder.sample[3]["token"]
    for read in (
        lambda da: da.load_image(sample, "Camera_Back"),
        lambda da: da.load_point_cloud(sample).xyz,
        lambda da: da.load_bev(sample).instance,
    ):
        assert np.array_equal(read(other), read(folder))


@pytest.mark.slow
@pytest.mark.parametrize("kind", STORES)
def test_a_release_in_a_store_is_valid_and_whole(
    places: dict[str, str], opened: dict[str, DeepAccident], kind: str
) -> None:
    root = opened[kind].dataroot
    one = opened[kind].scenario[0]["token"]
    found, plain = (validate_release(each, deep=True, workers=1, scenarios=[one]) for each in (root, places["folder"]))
    assert [finding.code for finding in found.findings] == [finding.code for finding in plain.findings]
    counts, of_folder = (release_completeness(each, workers=1) for each in (root, places["folder"]))
    assert (counts.total, counts.splits) == (of_folder.total, of_folder.splits)


@pytest.mark.parametrize("kind", STORES)
def test_the_truth_has_the_same_hashes(opened: dict[str, DeepAccident], kind: str) -> None:
    tokens = [record["token"] for record in opened["folder"].scenario[:2]]
    assert scenario_hashes(opened[kind], tokens, workers=1) == scenario_hashes(opened["folder"], tokens, workers=1)


@pytest.mark.parametrize("kind", STORES)
def test_a_path_is_given_only_where_there_is_one(opened: dict[str, DeepAccident], kind: str) -> None:
    dataset, token = opened[kind], opened[kind].sample[0]["token"]
    with pytest.raises(NotAvailableError, match=r"lies in an archive or at a URL; da\.local_path\(token\)"):
        dataset.get_sample_data_path(token, "lidar01")
    path, boxes, _ = dataset.get_sample_data(token, "lidar01")
    assert path == dataset.local_path(token, "lidar01")
    assert path.name == opened["folder"].get_sample_data_path(token, "lidar01").name
    assert len(boxes) == len(opened["folder"].get_boxes(token))


def test_local_path_of_a_folder_is_the_file_itself(da_partial: DeepAccident, da: DeepAccident) -> None:
    token = da.sample[0]["token"]
    assert da.local_path(token, "lidar01") == da.get_sample_data_path(token, "lidar01")
    absent = next(
        f"{record['token']}/{channel}"
        for record in da_partial.sample
        for channel in CHANNELS
        if not da_partial.get_sample_data_path(f"{record['token']}/{channel}").exists()
    )
    assert_refused((lambda: da_partial.local_path(absent), MissingFileError, "no such file"))


def test_the_frames_that_have_files_are_known_without_opening_one(da_partial: DeepAccident) -> None:
    for scenario in da_partial.scenario:
        assert da_partial.sensor_frames(scenario) == {
            (agent["name"], channel): tuple(
                frame
                for frame in range(1, scenario["num_frames"] + 1)
                if da_partial.sensor_path(f"{agent['token']}/{frame:03d}/{channel}").exists()
            )
            for agent in da_partial.agent
            if agent["scenario_token"] == scenario["token"]
            for channel in CHANNELS
        }


def test_a_file_that_no_archive_holds_is_missing(release_root: Path, tmp_path: Path) -> None:
    packed(release_root, tmp_path / "some.zip", chosen=lambda path: "lidar01" not in path.parts)
    dataset = DeepAccident(dataroot=tmp_path / "some.zip", workers=1, verbose=False)
    assert_refused(
        (lambda: dataset.load_point_cloud(dataset.sample[0]), MissingFileError, r"some\.zip/.*lidar01.*no such file"),
        (
            lambda: dataset.local_path(dataset.sample[0], "lidar01"),
            MissingFileError,
            "no such file; add the archive that holds it",
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", LOCAL_STORES)
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_workers_read_what_was_pickled(opened: dict[str, DeepAccident], kind: str, method: str) -> None:
    dataset, token = opened[kind], opened[kind].sample[2]["token"]
    expected = image_sum(opened["folder"], token)
    assert image_sum(dataset, token) == expected  # the archive is open before the fork
    assert image_sum(pickle.loads(pickle.dumps(dataset)), token) == expected
    with ProcessPoolExecutor(2, mp_context=get_context(method)) as pool:
        assert list(pool.map(image_sum, [dataset] * 4, [token] * 4)) == [expected] * 4


@pytest.mark.slow
@pytest.mark.parametrize("kind", LOCAL_STORES)
@pytest.mark.parametrize(
    "verb", ["index", "info", "validate --files", "validate", "export opencood --out {tmp_path}/opencood"]
)
def test_verbs_take_archives(places: dict[str, str], kind: str, tmp_path: Path, verb: str) -> None:
    """Every verb opens a dataroot in one of three ways: by the facade, by files alone, by the index."""
    words = verb.format(tmp_path=tmp_path).split()
    words.insert(1 + (verb[:6] == "export"), places[kind])
    words += [] if verb == "info" else ["--workers", "1"]
    words += [] if verb.startswith("validate") else ["--index-dir", str(tmp_path / "index")]
    result = CliRunner().invoke(deepaccident, words)
    assert result.exit_code == 0, result.output


@pytest.mark.slow
def test_exports_copy_what_they_would_link(opened: dict[str, DeepAccident], tmp_path: Path) -> None:
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.opencood import OpenCood

    for kind in ("folder", "zips"):
        export_release(opened[kind], tmp_path / kind, OpenCood(link="copy"), workers=1)
    found, expected = ({p.relative_to(tmp_path / k): p for p in files_of(tmp_path / k)} for k in ("zips", "folder"))
    assert [*found] == [*expected]
    for name in found:
        if name.suffix != ".json":
            assert found[name].read_bytes() == expected[name].read_bytes()


def test_an_unpacked_release_counts_and_not_the_archives_beside_it(own_release: Path) -> None:
    packed(own_release, own_release / "left.zip")
    assert DeepAccident(dataroot=own_release, workers=1, verbose=False).dataroot == own_release


def test_a_new_archive_is_noticed(release_root: Path, tmp_path: Path) -> None:
    agents = [path.name for path in (release_root / "type1_subtype1_accident").iterdir() if path.name != "meta"]
    folder, counts = tmp_path / "zips", []
    for agent in agents[:2]:
        packed(release_root, folder / f"{agent}.zip", chosen=lambda path, agent=agent: agent in path.parts)
        counts.append(len(DeepAccident(dataroot=folder, workers=1, verbose=False).sample))
    assert counts[0] < counts[1]
    assert len(list((folder / ".deepaccident").glob("files-*"))) == 1


def test_where_nothing_can_be_written_lists_are_kept_in_the_cache(
    places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deepaccident_devkit.release.store import opening

    monkeypatch.setattr("platformdirs.user_cache_path", lambda _: tmp_path / "cache")
    shutil.copy(places["zip"], tmp_path / "all.zip")
    writable = opening.is_writable_folder
    for module in (opening, __import__("deepaccident_devkit.tables.index", fromlist=["index"])):
        monkeypatch.setattr(module, "is_writable_folder", lambda path: "cache" in path.parts and writable(path))
    dataset = DeepAccident(dataroot=tmp_path / "all.zip", workers=1, verbose=False)
    assert tmp_path / "cache" in dataset.tables_folder.parents
    assert not (tmp_path / ".deepaccident").exists()


def test_as_many_archives_are_open_as_the_system_allows(
    places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepaccident_devkit.release.store.sources.MOST_OPEN", 2)
    folder = shutil.copytree(places["zips"], tmp_path / "zips")
    source, names = LocalSource(folder), sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.zip"))
    for name in names * 2:
        assert source.read(name, 0, 4) == b"PK\x03\x04"
        assert sum(folder in file.resolve().parents for file in Path("/proc/self/fd").iterdir()) <= 2


def test_a_copy_that_another_process_removes_is_read_from_the_url(
    opened: dict[str, DeepAccident], monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = opened["folder"].sample[5]["token"]
    monkeypatch.setattr(FileCache, "put", lambda *_: None)
    assert image_sum(opened["memory"], sample) == image_sum(opened["folder"], sample)


@pytest.mark.parametrize("kind", ["memory", "memory zips"])
def test_a_url_that_fails_amid_indexing_is_told(
    places: dict[str, str], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = Mock(side_effect=RefusedFileError(5, "cannot be read (the line is dead)"))
    monkeypatch.setattr(UrlSource, "read_all", gone)
    opening = partial(DeepAccident, dataroot=places[kind], index_dir=tmp_path, workers=1, verbose=False)
    named = ("memory://", ": cannot be read (the line is dead)", "check the connection")
    assert_refused((opening, SomeFailedError, named))


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
    assert cache.found(paths[0], 100)
    for path in paths[9:]:
        cache.put(path, bytes(100))
    there = [path.exists() for path in paths]
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.jpg")) <= 1000
    assert (there[0], there[-2:], there[1:4] != [True] * 3) == (True, [True, True], True)


def test_a_file_larger_than_the_cache_is_kept_alone(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, 100)
    small, large = cache.path_of("small", "a"), cache.path_of("large", "a")
    cache.put(small, bytes(50))
    cache.put(large, bytes(500))
    assert (large.exists(), small.exists()) == (True, False)
