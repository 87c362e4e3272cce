"""An export that is killed at any moment, or meets a full disk or another process, and the same call afterwards."""

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import killed
import pytest
from click.testing import CliRunner
from tiny_format import TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.parallel import Store

pytestmark = pytest.mark.slow

KILLS = {1: 16, 2: 4}
Job = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def job(small_root: Path) -> Iterator[Job]:
    command = [sys.executable, killed.__file__, "tiny_format"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018 - for the type checker
        asked, answers = server.stdin, server.stdout

        def run(folder: Path, workers: int = 1, **how: object) -> dict[str, Any]:
            """Export in the tests' own format, or by the command line that is given as `words`."""
            call = {"function": ["tiny_format", "export_tiny"], "arguments": [str(small_root), str(folder), workers]}
            asked.write(json.dumps({**({} if "words" in how else call), **how}) + "\n")
            asked.flush()
            answer: dict[str, Any] = json.loads(answers.readline())
            return answer

        yield run
        asked.close()


@pytest.fixture(scope="module")
def whole(small: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes | None]:
    return contents(export_release(small, tmp_path_factory.mktemp("whole") / "out", TinyFormat(), workers=1).folder)


def contents(folder: Path) -> dict[str, bytes | None]:
    return {
        path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")
    }


@pytest.mark.parametrize("after", [False, True])
def test_killed_around_every_renaming_and_removal(
    small: DeepAccident, tmp_path: Path, job: Job, whole: dict[str, bytes | None], after: bool
) -> None:
    step = 0
    while job(tmp_path / str(step), step=step, after=after)["status"] == -9:
        export_release(small, tmp_path / str(step), TinyFormat(), workers=1)
        assert contents(tmp_path / str(step)) == whole, step
        step += 1
    assert step > 40
    assert contents(tmp_path / str(step)) == whole


@pytest.mark.parametrize("name", ["opencood", "nuscenes"])
def test_a_format_killed_at_twenty_moments(
    small_root: Path, tmp_path: Path, job: Job, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def words(out: str) -> list[str]:
        own = ["--without-clouds"] if name == "opencood" else []
        return ["export", name, str(small_root), "--workers", "1", "--out", str(tmp_path / out), *own]

    renamed, replace = [], os.replace
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda source, target: (renamed.append(target), replace(source, target)))
        assert CliRunner().invoke(deepaccident, words("whole"), catch_exceptions=False).exit_code == 0
    whole = contents(tmp_path / "whole")
    for moment in range(20):
        out, step = str(moment), moment * (len(renamed) - 1) // 19
        assert job(tmp_path / out, words=words(out), step=step, after=bool(moment % 2))["status"] == -9
        assert contents(tmp_path / out) != whole or moment == 19  # killed after the last renaming
        assert job(tmp_path / out, words=words(out))["status"] == 0
        assert contents(tmp_path / out) == whole, moment


@pytest.mark.parametrize("workers", KILLS)
def test_killed_at_random_moments(tmp_path: Path, job: Job, whole: dict[str, bytes | None], workers: int) -> None:
    source, kills, stages = random.Random(workers), 0, set()  # noqa: S311 - the same moments every time
    seconds = job(tmp_path / "timed", workers)["seconds"]
    for attempt in range(4 * KILLS[workers]):
        out = tmp_path / str(attempt)
        kills += job(out, workers, delay=source.uniform(0, seconds))["status"] == -9
        stages.add(sum(len(files) for _, _, files in os.walk(out)))  # workers may still be ending
        assert job(out)["status"] == 0
        assert contents(out) == whole, attempt
        if kills == KILLS[workers]:
            break
    assert kills == KILLS[workers]
    assert len(stages) > 1  # the kills did not all fall into one moment


@pytest.mark.parametrize("limit", [0, 5, 60])
def test_a_full_disk(tmp_path: Path, job: Job, whole: dict[str, bytes | None], limit: int) -> None:
    """A limit on files' sizes stands for the disk."""
    answer = job(tmp_path / "out", limit=limit)
    assert answer["status"] == 1
    assert answer["message"].startswith(f"ExportError: {tmp_path / 'out'}: cannot be written (")
    assert answer["message"].endswith("; make room there, or choose another folder, and run it again")
    assert not [name for name in contents(tmp_path / "out") if ".tmp" in name]
    assert job(tmp_path / "out")["status"] == 0
    assert contents(tmp_path / "out") == whole


def test_processes_share_an_export(small_root: Path, tmp_path: Path, whole: dict[str, bytes | None]) -> None:
    script = "import sys, tiny_format; tiny_format.export_tiny(sys.argv[1], sys.argv[2], 1)"
    command = [sys.executable, "-c", script, str(small_root), str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    out = tmp_path / "out"
    with Store(out / ".deepaccident-parts", out, "writes an export", ExportError, "another command").shared():
        processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) for _ in range(2)]
        for process in processes:
            assert process.stderr
            assert "another process writes an export there; waiting for it" in process.stderr.readline()
        assert not (tmp_path / "out" / "tiny.manifest.json").exists()
    for process in processes:
        process.communicate(timeout=60)
        assert process.returncode == 0
    assert contents(tmp_path / "out") == whole
