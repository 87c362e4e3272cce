"""Exports in shards: the merged bytes, what is missing, failed scenarios, workers that were taken for lost."""

import threading
import time
from pathlib import Path
from typing import Any

import pytest
from tiny_format import TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ExportError, ReleaseError, SomeFailedError, UnfinishedError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.bulk.manifest import writing_to
from deepaccident_devkit.export.bulk.unfinished import Unfinished
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.parallel import MERGE, Shard
from deepaccident_devkit.selection import find

SCENARIOS = 3


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def written(small: DeepAccident, folder: Path, **options: Any) -> Exported:
    return export_release(small, folder, TinyFormat(), workers=1, **options)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_shards_merge_to_the_same_bytes(small: DeepAccident, tmp_path: Path, count: int) -> None:
    whole = written(small, tmp_path / "whole")
    shards = [written(small, tmp_path / "shards", part=f"{number}/{count}") for number in range(count, 0, -1)]
    assert sum(each.written for each in shards) == SCENARIOS
    assert sum(each.plan.samples for each in shards) == whole.plan.samples
    merged = written(small, tmp_path / "shards", part=MERGE)
    assert (merged.written, merged.kept) == (0, SCENARIOS)
    assert merged.tally == whole.tally
    assert contents(tmp_path / "shards") == contents(tmp_path / "whole")
    again = written(small, tmp_path / "shards", part=Shard(1, count))
    assert again.written == 0


def test_a_missing_shard(small: DeepAccident, tmp_path: Path) -> None:
    written(small, tmp_path, part="1/3")
    with pytest.raises(UnfinishedError, match=rf"^{tmp_path}: 2 of {SCENARIOS} are not done, such as \S+; run their"):
        written(small, tmp_path, part=MERGE)
    assert written(small, tmp_path).written == 2  # the whole does what is left


def test_mmdet3d_needs_the_whole_nuscenes_export(small: DeepAccident, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="holds no complete nuscenes export"):
        export_release(small, tmp_path / "out", Mmdet3d(), part="1/2")


def test_the_rest_is_done(small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, broken = TinyFormat.write, find(small)[1]["token"]

    def write(self: TinyFormat, dataset: Any, unit: Any, output: Any) -> None:
        if unit.scenarios == (broken,):
            raise ReleaseError("cloud.npz: is broken; restore it")
        whole(self, dataset, unit, output)

    with monkeypatch.context() as patch:
        patch.setattr(TinyFormat, "write", write)
        with pytest.raises(SomeFailedError, match=rf"^{tmp_path}/out: 1 of 3 failed:\n  \S+: cloud.npz: is broken; re"):
            written(small, tmp_path / "out")
    assert written(small, tmp_path / "out").written == 1
    written(small, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_worker_that_was_taken_for_lost_keeps_its_unit(
    small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a scheduler that died: the next call neither takes its half-written files away nor writes beside it."""
    whole, begun, go_on = TinyFormat.write, threading.Event(), threading.Event()

    def write(self: TinyFormat, dataset: Any, unit: Any, output: Any) -> None:
        with output.whole_folder(f"folders/{unit.name}") as folder:
            folder.write("names.json", b"half")
            begun.set()
            assert go_on.wait(20)
        output.tally.files, output.tally.bytes = 0, 0
        whole(self, dataset, unit, output)

    first = {"part": "1/3"}
    with monkeypatch.context() as patch:
        patch.setattr(TinyFormat, "write", write)
        lost = threading.Thread(target=written, args=(small, tmp_path / "out"), kwargs=first)
        lost.start()
        assert begun.wait(20)
    again = threading.Thread(target=written, args=(small, tmp_path / "out"), kwargs=first)
    again.start()
    time.sleep(0.3)
    assert again.is_alive()
    go_on.set()
    lost.join()
    again.join()
    written(small, tmp_path / "out")
    written(small, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_what_another_host_left_of_a_unit_is_removed(small: DeepAccident, tmp_path: Path) -> None:
    written(small, tmp_path / "out", part="1/3")
    unfinished = Unfinished(tmp_path / "out", "tiny")
    (unit,) = (each.name.removesuffix(".paths") for each in unfinished.folder.glob("*.paths"))
    (unfinished.folder / unit / "done.json").unlink()
    left = tmp_path / "out" / "folders" / f".{unit[:50]}.0123abcd-77-99-1.tmp"
    left.mkdir()
    other = left.with_name(".another.0123abcd-77-99-1.tmp")
    other.mkdir()
    written(small, tmp_path / "out", part="1/3")
    assert not left.exists()
    assert other.exists()  # of a unit that may be written at this moment


def test_shards_write_together_and_the_merging_waits(tmp_path: Path) -> None:
    merging = threading.Event()

    def merge() -> None:
        with writing_to(tmp_path):
            merging.set()

    with writing_to(tmp_path, shared=True):
        with writing_to(tmp_path, shared=True):
            thread = threading.Thread(target=merge)
            thread.start()
        assert not merging.wait(0.2)
    thread.join(10)
    assert merging.is_set()
