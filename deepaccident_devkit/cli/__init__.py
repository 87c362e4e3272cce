"""The command line: `deepaccident <verb>`, one module for each verb; plug-ins add theirs.

A verb parses, makes one library call and prints. Exit status: 0 good, 1 findings, 2 error; 130 after Ctrl-C, 143 after
SIGTERM, 141 if the reader of the output went away.
"""

import logging
import os
import platform
import re
import sys
from functools import partial
from importlib import import_module
from typing import Final

import click

from deepaccident_devkit.cli.process import lasting_streams, run_interruptibly
from deepaccident_devkit.cli.verbs import LazyVerbs
from deepaccident_devkit.errors import DeepAccidentError, SomeFailedError
from deepaccident_devkit.support.plugins import LazyVerb, Plugin
from deepaccident_devkit.support.version import __version__

_ERROR_STATUS = 2
_FINDINGS_STATUS = 1
# Loggers of its parts.
_OF_DASK = ("distributed", "tornado", "asyncio")
# Requirements for work on the devkit itself.
_DEVELOPERS: Final = re.compile(r"extra == .(test|lint|docs)\b")
# Verb of the core, each in a module of its name → its line in the list of verbs.
_SUMMARIES: Final = {
    "check": "Check a release, an index, results, an evaluation, splits or a reader.",
    "cache": "Write resized images for training.",
    "evaluate": "Evaluate results files; compare evaluations.",
    "export": "Write data in the formats of other tools.",
    "index": "Make, update or remove the index of a release.",
    "info": "Print what a release holds, its statistics, its index.",
    "labels": "Write motion labels.",
    "render": "Render pictures, videos and replays.",
    "results": "Make results files of those of other tools.",
    "split": "Make the official splits, or a split file of scenarios.",
    "validate": "Print what is wrong, unusual or missing in a release.",
}


def _core_verb(name: str) -> click.Command:
    verb: click.Command = getattr(import_module(f"{__name__}.{name}"), name)
    return verb


def _plugin_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the verbs that a plug-in offers, except those of groups, such as `check splits`."""
    return {name: verb for name, verb in plugin.verbs.items() if " " not in name}


_VERBS: Final = {
    name: LazyVerb(summary, partial(_core_verb, name)) for name, summary in _SUMMARIES.items()
}


@click.group(
    cls=LazyVerbs,
    verbs=_VERBS,
    read_plugin=_plugin_verbs,
    invoke_without_command=True,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option("--version", is_flag=True, help="Show the version and exit.")
@click.option(
    "--all",
    "every",
    is_flag=True,
    help="With --version: also the versions of Python and all libraries.",
)
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
    from importlib.metadata import (
        PackageNotFoundError,
        requires,
        version,
    )  # here: it takes longer than all the rest

    from deepaccident_devkit.support.text import columns_text

    def installed(name: str) -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return "not installed"

    users = [each for each in requires("deepaccident_devkit") or () if not _DEVELOPERS.search(each)]
    names = sorted(
        {match.group().lower() for each in users if (match := re.match(r"[\w.-]+", each))}
    )
    rows = [
        ("deepaccident", __version__),
        ("Python", platform.python_version()),
        ("system", platform.platform()),
    ]
    return columns_text([*rows, *((name, installed(name)) for name in names)])


def main() -> None:
    """Run the command line; errors that the user can mend become one message and exit status 2."""
    # no window, and no file of the user changes a picture; in worker processes too
    os.environ |= {"MPLBACKEND": "Agg", "MATPLOTLIBRC": os.devnull}
    with lasting_streams():
        _run()


def _run() -> None:
    shown = logging.StreamHandler()
    shown.addFilter(
        lambda record: record.name.partition(".")[0] not in _OF_DASK
    )  # its errors come as exceptions too
    logging.basicConfig(
        level=logging.WARNING, format="%(levelname)s: %(message)s", handlers=[shown]
    )
    try:
        run_interruptibly(deepaccident)
    except (
        DeepAccidentError,
        OSError,
        MemoryError,
    ) as error:  # OSErrors: a full disk, a folder without permission
        *_, told = str(error).rpartition(
            f".{type(error).__name__}: "
        )  # a loader's worker puts its traceback before it
        if isinstance(error, MemoryError):
            told = "memory ran out; use fewer workers (--workers), or a machine with more memory"
        click.echo(f"error: {told}", err=True)
        sys.exit(_FINDINGS_STATUS if isinstance(error, SomeFailedError) else _ERROR_STATUS)
