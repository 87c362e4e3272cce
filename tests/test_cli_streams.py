"""What verbs print, on any terminal and on none: nothing that they write depends on it, and no
letter ends them.
"""

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.cli.process import Stream
from deepaccident_devkit.plugins.baselines import predict_results

HOSTILE = "town\x1b[31m\x07\x9b\u202e\udcff"
SHOWN = r"town\u001b[31m\u0007\u009b\u202e\udcff"
OUTPUTS = {"closed pipe": 141, "full": 2, "latin-1": 0, "ascii": 0, "none": 0}
"""What a verb's standard output leads to → its exit status."""


def shown(*texts: str, encoding: str = "utf-8") -> str:
    """What a terminal of an encoding gets."""
    beneath = io.BytesIO()
    stream = Stream(io.TextIOWrapper(beneath, encoding, newline=""))
    for text in texts:
        assert stream.write(text) == len(text)
    stream.flush()
    return beneath.getvalue().decode(encoding)


BARS = ("\rindexing:  50%|█| 1/2", "\n", "\x1b[A", "\n\n\x1b[A\x1b[A", "")


@pytest.mark.parametrize(
    ("text", "told"),
    [(f"{HOSTILE}\n\tnext\r\n", f"{SHOWN}\n\tnext\\u000d\n"), *zip(BARS, BARS, strict=True)],
)
def test_a_strangers_text_moves_no_cursor_and_progress_bars_do(text: str, told: str) -> None:
    assert shown(text) == told


def test_json_stays_the_same_document() -> None:
    document = {"town": HOSTILE, HOSTILE: ["é", 1]}
    assert json.loads(shown(json.dumps(document, ensure_ascii=False))) == document


@pytest.mark.parametrize(
    ("encoding", "told"),
    [
        ("ascii", "m, N, ,  "),
        ("latin-1", "m², N, , é "),
        ("cp1252", "m², N…, , é "),
        ("utf-8", "m², N…, 車, é 😀"),
    ],
)
def test_a_letter_that_the_terminal_lacks_is_replaced(encoding: str, told: str) -> None:
    assert shown("m², N…, 車, é 😀", encoding=encoding).replace("?", "") == told


def test_a_stream_without_an_encoding_or_a_descriptor_will_do() -> None:
    beneath = io.StringIO()
    Stream(beneath).write(HOSTILE)
    assert beneath.getvalue() == SHOWN


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "accident.json"
    tokens = da_motion.samples("train", "evaluate", "paper", scope="all")
    return predict_results(da_motion, "accident", tokens, path, workers=1)


IN_TRAIN = (
    "--split",
    "train",
    "--scope",
    "all",
    "--protocol",
    "boxes",
    "--resamples",
    0,
    "--workers",
    1,
)
WRITING: dict[str, Callable[[Any, Path, Path], tuple[object, ...]]] = {
    "evaluate": lambda root, results, out: (
        "evaluate",
        "accident",
        root,
        "--results",
        results,
        *IN_TRAIN,
        "--out",
        out,
    ),
    "stats": lambda root, _, out: ("info", root, "--statistics", "--out", out, "--workers", 1),
    "describe": lambda root, _, out: (
        "safety",
        "describe",
        root,
        "--out",
        out / "told.jsonl",
        "--workers",
        1,
    ),
    "render": lambda root, _, out: ("render", "bev", root, "--frame-range", "1..2", "--out", out),
    "parquet": lambda root, _, out: ("export", "parquet", root, "--out", out, "--workers", 1),
    "predict": lambda root, _, out: (
        "predict",
        "constant_velocity",
        root,
        *IN_TRAIN[:4],
        "--out",
        out,
        "--workers",
        1,
    ),
}
"""Verb that writes and prints → its words, for a release, results and a folder."""


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["evaluate", "stats", "describe"])
def test_all_is_written_before_anything_is_printed(
    da_motion: DeepAccident,
    results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    verb: str,
) -> None:
    def words(name: str) -> list[str]:
        (tmp_path / name).mkdir()
        return [str(word) for word in WRITING[verb](da_motion.dataroot, results, tmp_path / name)]

    assert CliRunner().invoke(deepaccident, words("usual"), catch_exceptions=False).exit_code == 0
    monkeypatch.setattr(click, "echo", lambda *_, **__: sys.exit(7))
    assert CliRunner().invoke(deepaccident, words("mute"), catch_exceptions=False).exit_code == 7
    assert files(tmp_path / "mute") == files(tmp_path / "usual") != set()


def run(*words: object, output: str) -> subprocess.CompletedProcess[bytes]:
    """A verb in a process of its own, whose standard output leads to one of `OUTPUTS`."""
    encoding = output if output in ("latin-1", "ascii") else "utf-8"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONIOENCODING": encoding,
    }
    command = [sys.executable, "-m", "deepaccident_devkit", *map(str, words)]
    closed = ["sh", "-c", 'exec "$@" >&-', "sh"] if output == "none" else []
    reading, writing = os.pipe()
    os.close(reading)
    to = {"closed pipe": writing, "full": os.open("/dev/full", os.O_WRONLY)}.get(
        output, subprocess.PIPE
    )
    return subprocess.run(
        [*closed, *command], stdout=to, stderr=subprocess.PIPE, env=environment, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "output"),
    [
        *(("stats", output) for output in OUTPUTS),
        ("render", "full"),
        ("parquet", "closed pipe"),
        ("predict", "none"),
    ],
)
def test_what_is_written_does_not_depend_on_who_reads(
    da_motion: DeepAccident, results: Path, tmp_path: Path, verb: str, output: str
) -> None:
    done = run(*WRITING[verb](da_motion.dataroot, results, tmp_path), output=output)
    told = [
        line
        for line in done.stderr.decode().splitlines()
        if line.startswith("error") or "Traceback" in line
    ]
    full = (
        "error: standard output: cannot be written (No space left on device); files that "
        "the command wrote are whole"
    )
    assert (done.returncode, told) == (OUTPUTS[output], [full] * (output == "full"))
    assert len(files(tmp_path)) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("to", [">&-", ">/dev/full"])
def test_a_verb_that_fails_keeps_its_status_without_standard_error(to: str, tmp_path: Path) -> None:
    command = f'"{sys.executable}" -m deepaccident_devkit info "{tmp_path}/nothing" 2{to}'
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run(["sh", "-c", command], env=environment, check=False).returncode == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [("MPLBACKEND", "module://not_there"), ("MATPLOTLIBRC", "{}/rc")],
)
def test_no_setting_of_matplotlib_ends_a_verb(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    (tmp_path / "rc").write_text(
        "backend: nonsense\ntext.usetex: true\nimage.origin: lower\nno such setting\n"
    )
    monkeypatch.setenv(name, value.format(tmp_path))
    words = (
        "render",
        "bev",
        da_motion.dataroot,
        "--layers",
        "boxes",
        "--out",
        tmp_path / "bev.png",
    )
    done = run(*words, output="utf-8")
    assert (done.returncode, done.stderr, (tmp_path / "bev.png").is_file()) == (0, b"", True)
