"""Run the bulk commands, which must write the same bytes on every engine."""

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
"""Command line by name."""


class Local(NamedTuple):
    """The outputs of the commands on this machine without a cluster.

    Attributes:
        paths: Folders by the name that `COMMANDS` gives them.
        files: Contents by path below the folder `out`.
        printed: Output of the command `validate`.
    """

    paths: dict[str, Path]
    files: dict[str, bytes]
    printed: str


class Cluster(NamedTuple):
    """A dask cluster in its own process.

    Attributes:
        address: Address of the scheduler.
        workers: Process ids of the workers.
    """

    address: str
    workers: list[int]


def command_line(name: str, paths: dict[str, Path]) -> list[str]:
    return COMMANDS[name].format(**paths).split()


def python_command(arguments: Sequence[str]) -> list[str]:
    """Prepend the Python that runs the devkit in its own process."""
    return [sys.executable, "-m", "deepaccident_devkit.cli", *arguments]


def run(command: Sequence[str], **environment: str) -> str:
    """Run a command to its end and return its output."""
    result = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )

    assert result.returncode in (0, 1), result.stderr  # 1: `validate` has findings

    return result.stdout


def read_files(folder: Path, prefix: str = "") -> dict[str, bytes]:
    """Read all files but the locks.

    Returns:
        Content by the path below the folder, with the prefix before it.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.endswith(".lock"):
            files[prefix + str(path.relative_to(folder))] = path.read_bytes()
    return files


def opencood_files(local: Local) -> dict[str, bytes]:
    """Select the files of the OpenCOOD export."""
    return {path: data for path, data in local.files.items() if path.startswith("opencood/")}
