"""The command line: `deepaccident <verb>`, one module for each verb; those of a room are there.

A verb parses, makes one library call and prints. Exit status: 0 good, 1 findings, 2 error; 130 after Ctrl-C, 143 after
SIGTERM, 141 if the reader of the output went away.
"""

import logging
import os
import platform
import re
import sys
from importlib import import_module
from typing import Final

import click

from deepaccident_devkit._version import __version__
from deepaccident_devkit.cli.process import lasting_streams, run_interruptibly
from deepaccident_devkit.cli.verbs import LazyVerbs
from deepaccident_devkit.errors import DeepAccidentError, SomeFailedError

_ERROR_STATUS = 2
_FINDINGS_STATUS = 1
_OF_DASK = ("distributed", "tornado", "asyncio")
"""Loggers of its parts."""
_DEVELOPERS: Final = re.compile(r"extra == .(test|lint|docs)\b")
"""Requirements for work on the devkit itself."""
_VERBS: Final = {
    "audit": "Find splits that leak, scores that cheat, and columns that were misread.",
    "cache": "Write resized images for training.",
    "demo": "Make a small synthetic release, and a page on it.",
    "evaluate": "Evaluate results files; check and compare evaluations.",
    "explore": "Show a release in the browser.",
    "export": "Write data in the formats of other tools.",
    "index": "Make, update or remove the index of a release.",
    "info": "Print what a release holds, its statistics, its index.",
    "labels": "Write motion labels.",
    "predict": "Predict with a trained model, or with a baseline.",
    "render": "Render pictures, videos and replays.",
    "results": "Make results files of those of other tools.",
    "rigs": "Compare what the vehicles of two sources carry.",
    "safety": "Look into accidents: who saw it first, when it was too late.",
    "split": "Make the official splits, or a split file of scenarios.",
    "study": "Train and compare what a recipe says.",
    "synth": "Make a synthetic release.",
    "train": "Train the model.",
    "validate": "Print what is wrong, unusual or missing in a release.",
}


def _verb(name: str) -> click.Command:
    """A verb: one of a room, or of this package; raises MissingRoomError."""
    from deepaccident_devkit.rooms import ADDED, added  # here: the list of verbs needs none of it

    found: click.Command = (
        added("verb", name) if name in ADDED["verb"] else getattr(import_module(f"{__name__}.{name}"), name)
    )
    return found


@click.group(
    cls=LazyVerbs,
    verbs=_VERBS,
    load=_verb,
    invoke_without_command=True,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option("--version", is_flag=True, help="Show the version and exit.")
@click.option("--all", "every", is_flag=True, help="With --version: also the versions of Python and all libraries.")
@click.pass_context
def deepaccident(context: click.Context, version: bool, every: bool) -> None:
    """Tools for the DeepAccident V2X accident dataset."""
    if version:
        click.echo(_versions() if every else f"deepaccident, version {__version__}")
        context.exit()
    if every:
        raise click.UsageError("--all needs --version")


def _versions() -> str:
    """What a report of a bug needs: the versions of the devkit, Python, the system and each library of any extra."""
    from importlib.metadata import PackageNotFoundError, requires, version  # here: it takes longer than all the rest

    from deepaccident_devkit.support.text import columns_text

    def installed(name: str) -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return "not installed"

    users = [each for each in requires("deepaccident_devkit") or () if not _DEVELOPERS.search(each)]
    names = sorted({match.group().lower() for each in users if (match := re.match(r"[\w.-]+", each))})
    rows = [("deepaccident", __version__), ("Python", platform.python_version()), ("system", platform.platform())]
    return columns_text([*rows, *((name, installed(name)) for name in names)])


def main() -> None:
    """Run the command line; errors that the user can mend become one message and exit status 2."""
    # no window, and no file of the user changes a picture; in worker processes too
    os.environ |= {"MPLBACKEND": "Agg", "MATPLOTLIBRC": os.devnull}
    with lasting_streams():
        _run()


def _run() -> None:
    shown = logging.StreamHandler()
    shown.addFilter(lambda record: record.name.partition(".")[0] not in _OF_DASK)  # its errors come as exceptions too
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", handlers=[shown])
    try:
        run_interruptibly(deepaccident)
    except (DeepAccidentError, OSError, MemoryError) as error:  # OSErrors: a full disk, a folder without permission
        *_, told = str(error).rpartition(f".{type(error).__name__}: ")  # a loader's worker puts its traceback before it
        if isinstance(error, MemoryError):
            told = "memory ran out; use fewer workers (--workers), or a machine with more memory"
        click.echo(f"error: {told}", err=True)
        sys.exit(_FINDINGS_STATUS if isinstance(error, SomeFailedError) else _ERROR_STATUS)
