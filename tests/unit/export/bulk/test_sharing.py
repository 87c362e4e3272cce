"""Exports that several processes write: their bytes, failed scenarios, workers that were taken for lost."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from tiny_format import TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ReleaseError, SomeFailedError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.selection import find

SCENARIOS = 3


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def written(small: DeepAccident, folder: Path, **options: Any) -> Exported:
    return export_release(small, folder, TinyFormat(), workers=1, **options)


def test_several_calls_share_the_scenarios(small: DeepAccident, tmp_path: Path) -> None:
    whole = written(small, tmp_path / "whole")
    with ThreadPoolExecutor(3) as threads:
        done = list(threads.map(lambda _: written(small, tmp_path / "shared"), range(3)))
    assert sum(each.written for each in done) == SCENARIOS
    assert {each.tally.files for each in done} == {whole.tally.files}
    assert contents(tmp_path / "shared") == contents(tmp_path / "whole")


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
        left = written(small, tmp_path / "out", dry_run=True)
        assert (left.written, left.tally.samples) == (1, 0)
        assert written(small, tmp_path / "other", dry_run=True).tally.samples > 0
    assert written(small, tmp_path / "out").written == 1
    written(small, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_worker_that_was_taken_for_lost_keeps_its_unit(
    small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a scheduler that died: the next call neither takes its half-written files away nor writes beside it."""
    whole, begun, go_on, first = TinyFormat.write, threading.Event(), threading.Event(), iter([True])

    def write(self: TinyFormat, dataset: Any, unit: Any, output: Any) -> None:
        if next(first, False):
            with output.whole_folder(f"folders/{unit.name}") as folder:
                folder.write("names.json", b"half")
                begun.set()
                assert go_on.wait(20)
            output.tally.files, output.tally.bytes = 0, 0
        whole(self, dataset, unit, output)

    monkeypatch.setattr(TinyFormat, "write", write)
    lost = threading.Thread(target=written, args=(small, tmp_path / "out"))
    lost.start()
    assert begun.wait(20)
    (tmp_path / "out" / ".deepaccident-parts" / ".making").unlink()  # of a caller that is dead
    again = threading.Thread(target=written, args=(small, tmp_path / "out"))
    again.start()
    time.sleep(0.3)
    assert again.is_alive()
    go_on.set()
    lost.join()
    again.join()
    written(small, tmp_path / "whole")
    found = contents(tmp_path / "out")
    locks = {name for name in found if name.startswith(".deepaccident-parts/locks/")}  # of the lost one's next units
    assert {name: found[name] for name in found.keys() - locks} == contents(tmp_path / "whole")


def test_what_another_host_left_of_a_unit_is_removed(small: DeepAccident, tmp_path: Path) -> None:
    written(small, tmp_path / "out")
    kept = tmp_path / "out" / ".deepaccident-parts" / "kept" / "tiny"
    unit = min(each.name.removesuffix(".paths") for each in kept.glob("[!.]*.paths"))
    (kept / unit / "done").unlink()
    manifest = tmp_path / "out" / "tiny.manifest.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "release": None}))
    left = tmp_path / "out" / "folders" / f".{unit[:50]}.0123abcd-77-99-1.tmp"
    left.mkdir()
    written(small, tmp_path / "out")
    assert not left.exists()
