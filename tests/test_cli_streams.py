"""What verbs print on any terminal, or without one.

The files that they write do not depend on it, and no letter makes them fail.
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

HOSTILE_TEXT = "town\x1b[31m\x07\x9b\u202e\udcff"
ESCAPED_TEXT = r"town\u001b[31m\u0007\u009b\u202e\udcff"
STATUS_BY_OUTPUT = {"closed pipe": 141, "full": 2, "latin-1": 0, "ascii": 0, "none": 0}
"""Destination of a verb's standard output → exit status."""


def print_texts(*texts: str, encoding: str = "utf-8") -> str:
    """Return what a terminal with an encoding receives."""
    terminal = io.BytesIO()
    stream = Stream(io.TextIOWrapper(terminal, encoding, newline=""))
    for text in texts:
        assert stream.write(text) == len(text)
    stream.flush()
    return terminal.getvalue().decode(encoding)


BARS = ("\rindexing:  50%|█| 1/2", "\n", "\x1b[A", "\n\n\x1b[A\x1b[A", "")


@pytest.mark.parametrize(
    ("text", "received"),
    [
        (f"{HOSTILE_TEXT}\n\tnext\r\n", f"{ESCAPED_TEXT}\n\tnext\\u000d\n"),
        *zip(BARS, BARS, strict=True),
    ],
)
def test_progress_bars_move_the_cursor_but_foreign_text_does_not(text: str, received: str) -> None:
    assert print_texts(text) == received


def test_json_stays_the_same_document() -> None:
    document = {"town": HOSTILE_TEXT, HOSTILE_TEXT: ["é", 1]}
    assert json.loads(print_texts(json.dumps(document, ensure_ascii=False))) == document


@pytest.mark.parametrize(
    ("encoding", "received"),
    [
        ("ascii", "m, N, ,  "),
        ("latin-1", "m², N, , é "),
        ("cp1252", "m², N…, , é "),
        ("utf-8", "m², N…, 車, é 😀"),
    ],
)
def test_a_letter_that_the_terminal_lacks_is_replaced(encoding: str, received: str) -> None:
    assert print_texts("m², N…, 車, é 😀", encoding=encoding).replace("?", "") == received


def test_a_stream_without_an_encoding_or_a_descriptor_works() -> None:
    terminal = io.StringIO()
    Stream(terminal).write(HOSTILE_TEXT)
    assert terminal.getvalue() == ESCAPED_TEXT


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "accident.json"
    tokens = da_motion.samples("train", "evaluate", "paper", scope="all")
    return predict_results(da_motion, "accident", tokens, path, workers=1)


EVALUATION_OPTIONS = (
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
VERBS: dict[str, Callable[[Any, Path, Path], tuple[object, ...]]] = {
    "evaluate": lambda root, results, out: (
        "evaluate",
        "accident",
        root,
        "--results",
        results,
        *EVALUATION_OPTIONS,
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
        *EVALUATION_OPTIONS[:4],
        "--out",
        out,
        "--workers",
        1,
    ),
}
"""Verb that writes and prints → its words, for a release, results and an output folder."""


def list_files(folder: Path) -> set[str]:
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
        return [str(word) for word in VERBS[verb](da_motion.dataroot, results, tmp_path / name)]

    result = CliRunner().invoke(deepaccident, words("usual"), catch_exceptions=False)
    assert result.exit_code == 0
    monkeypatch.setattr(click, "echo", lambda *_, **__: sys.exit(7))
    result = CliRunner().invoke(deepaccident, words("mute"), catch_exceptions=False)
    assert result.exit_code == 7
    assert list_files(tmp_path / "mute") == list_files(tmp_path / "usual") != set()


def run(*words: object, output: str) -> subprocess.CompletedProcess[bytes]:
    """Run a verb in its own process, with its standard output led to one of `STATUS_BY_OUTPUT`."""
    encoding = output if output in ("latin-1", "ascii") else "utf-8"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONIOENCODING": encoding,
    }
    command = [sys.executable, "-m", "deepaccident_devkit", *map(str, words)]
    if output == "none":
        command = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
    read_end, write_end = os.pipe()
    os.close(read_end)
    descriptors = {"closed pipe": write_end, "full": os.open("/dev/full", os.O_WRONLY)}
    return subprocess.run(
        command,
        stdout=descriptors.get(output, subprocess.PIPE),
        stderr=subprocess.PIPE,
        env=environment,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "output"),
    [
        *(("predict", output) for output in STATUS_BY_OUTPUT),
        ("render", "full"),
        ("parquet", "closed pipe"),
        ("stats", "none"),
    ],
)
def test_written_files_do_not_depend_on_the_standard_output(
    da_motion: DeepAccident, results: Path, tmp_path: Path, verb: str, output: str
) -> None:
    process = run(*VERBS[verb](da_motion.dataroot, results, tmp_path), output=output)

    lines = process.stderr.decode().splitlines()
    errors = [line for line in lines if line.startswith("error") or "Traceback" in line]
    disk_is_full = (
        "error: standard output: cannot be written (No space left on device); the files that "
        "the command wrote are complete"
    )
    assert process.returncode == STATUS_BY_OUTPUT[output]
    assert errors == ([disk_is_full] if output == "full" else [])
    assert len(list_files(tmp_path)) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("redirection", [">&-", ">/dev/full"])
def test_a_verb_that_fails_keeps_its_status_without_standard_error(
    redirection: str, tmp_path: Path
) -> None:
    command = f'"{sys.executable}" -m deepaccident_devkit info "{tmp_path}/nothing" 2{redirection}'
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run(["sh", "-c", command], env=environment, check=False).returncode == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [("MPLBACKEND", "module://not_there"), ("MATPLOTLIBRC", "{}/rc")],
)
def test_no_setting_of_matplotlib_makes_a_verb_fail(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    (tmp_path / "rc").write_text(
        "backend: nonsense\ntext.usetex: true\nimage.origin: lower\nno such setting\n"
    )
    monkeypatch.setenv(name, value.format(tmp_path))
    out = tmp_path / "bev.png"
    words = ("render", "bev", da_motion.dataroot, "--layers", "boxes", "--out", out)
    process = run(*words, output="utf-8")
    assert process.returncode == 0
    assert process.stderr == b""
    assert out.is_file()
