"""What SECURITY.md says that the devkit does not notice, and what notices it: each claim is tried."""

import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign.healthy import AGENTS, CHANNELS, EXPORT, make_healthy, opened

from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.image_cache import ImageCache
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index
from deepaccident_devkit.validation import validate_release

PAGE = Path(__file__).parents[1] / "SECURITY.md"


@pytest.fixture
def healthy(tmp_path: Path) -> Path:
    return make_healthy(tmp_path / "healthy", weights=False)


def said(words: str) -> bool:
    """Whether the page says it, however its lines are broken."""
    return words in " ".join(PAGE.read_text(encoding="utf-8").split())


def flipped(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def test_a_changed_table_of_the_index_is_noticed_by_a_check(healthy: Path) -> None:
    root, index = healthy / "release", healthy / "index"
    before = repr(list(opened(root, index).sample))
    (table,) = index.glob("v1/tables-*/sample.arrow")
    number = np.float64(opened(root, index).sample[0]["velocity"][0]).tobytes()
    flipped(table, table.read_bytes().index(number) + 3)
    assert repr(list(opened(root, index).sample)) != before
    open_index(find_release(root), index_dir=index, workers=1, check_files=True)
    assert repr(list(opened(root, index).sample)) == before
    assert said("changed bytes in a table of an index: `deepaccident index --check` finds them")


def test_a_changed_member_of_a_zip_is_noticed_by_validate(healthy: Path) -> None:
    path = healthy / "zips" / "stored.zip"
    with zipfile.ZipFile(path) as archive:
        entry = next(each for each in archive.infolist() if "/label/" in each.filename)
        first = archive.read(entry).splitlines()[1]
    place = path.read_bytes().index(first)
    digit = first.index(b".") + 1
    flipped(path, place + digit)
    dataset = opened(path, healthy / "index of the zip")
    assert all(len(dataset.boxes(each["token"])) > 0 for each in dataset.sample)
    findings = [str(each) for each in validate_release(path, workers=1).findings]
    assert any("do not agree with its checksum" in each and Path(entry.filename).name in each for each in findings)
    assert said("a changed byte in a member of a zip with a release: `deepaccident validate` finds it")


def test_exchanged_files_of_an_images_cache_are_not_noticed(healthy: Path) -> None:
    dataset = opened(healthy / "sensors", healthy / "index_of_sensors")
    tokens = [f"{each['token']}/{AGENTS[0]}/001/{CHANNELS[0]}" for each in dataset.scenario]

    def images() -> list[Any]:
        cache = ImageCache(healthy / "cache")
        cache.check_release(dataset, [token.rsplit("/", 2)[0] for token in tokens])
        return [cache.load(cache.images, dataset, token)[0].copy() for token in tokens]

    before = images()
    first, second = sorted((healthy / "cache").glob("*.images"))
    aside = first.rename(first.with_suffix(".aside"))
    second.rename(first)
    aside.rename(second)
    assert np.array_equal(images(), before[::-1])
    assert said("files of an images cache that are exchanged")


def test_changed_files_of_a_complete_export_are_not_noticed(healthy: Path) -> None:
    folder, dataset = healthy / "exports" / "whole", opened(healthy / "release", healthy / "index")
    one, other = sorted(folder.rglob("*.yaml"))[:2]
    one.write_bytes(b"changed")
    other.unlink()
    assert export_release(dataset, folder, EXPORT, workers=1).written == 0
    assert one.read_bytes() == b"changed"
    assert not other.exists()
    assert said("files of an export that are changed or gone")


def test_a_done_record_is_believed(healthy: Path) -> None:
    folder, dataset = healthy / "exports" / "begun", opened(healthy / "release", healthy / "index")
    (done,) = folder.glob(".deepaccident-parts/kept/opencood/*/done")
    scenario = done.parent.name
    shutil.rmtree(next(folder.glob(f"*/{scenario}")))
    assert export_release(dataset, folder, EXPORT, workers=1).kept == 1
    assert not [path for path in folder.rglob("*.yaml") if scenario in str(path)]
    assert said("what an unfinished export notes as done")
