"""What bulk commands make of one release, on whatever engine: the same bytes."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

COMMANDS = {
    "index": "index {release} --index-dir {out}/index",
    "validate": "validate {release} --json",
    "labels": "labels {release} --split train --samples evaluate --out {out}/labels",
    "opencood": "export opencood {release} --without-clouds --out {out}/opencood",
    "evaluate": "evaluate accident {release} --results {results}/motion --split "
    "train --resamples 20 "
    "--out {out}/bundle",
    "predict": "predict constant_velocity {release} --split train --task accident "
    "--out {out}/predictions",
    "stats": "info {release} --statistics --out {out}/stats",
    "synth": "synth {out}/made --scenarios 3 --frames 3 --size 64x36 --seed 5",
}
"""Name → command line."""


class Local(NamedTuple):
    """What the commands made here without a cluster: files by path, and what each printed of the
    release.
    """

    places: dict[str, Path]
    files: dict[str, bytes]
    printed: str


class Cluster(NamedTuple):
    """A dask cluster in a process of its own: its scheduler's address, and the processes of its
    workers.
    """

    address: str
    workers: list[int]


def words(name: str, places: dict[str, Path]) -> list[str]:
    """The command line of a product."""
    return COMMANDS[name].format(**places).split()


def command(arguments: Sequence[str]) -> list[str]:
    """A process of its own, as a user has it."""
    return [sys.executable, "-m", "deepaccident_devkit.cli", *arguments]


def done(line: Sequence[str], **environment: str) -> str:
    """Run a command to its end; what it printed."""
    ended = subprocess.run(
        line,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )
    assert ended.returncode in (0, 1), ended.stderr  # 1: what `validate` finds
    return ended.stdout


def contents(folder: Path) -> dict[str, bytes]:
    """Path → bytes of all that was made; not the locks."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.endswith(".lock")
    }
