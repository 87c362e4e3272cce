"""The command line: `deepaccident <verb>`, one module for each verb; plug-ins add further verbs.

A verb parses, makes one library call and prints. Exit status: 0 good, 1 findings, 2 error; 130
after Ctrl-C, 143 after SIGTERM, 141 if the reader of the output went away.
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
# Loggers of dask's packages.
_DASK_LOGGERS = ("distributed", "tornado", "asyncio")
# Requirements for work on the devkit itself.
_DEVELOPER_EXTRA: Final = re.compile(r"extra == .(test|lint|docs)\b")
# Verb of the core, with a module of the same name → its line in the list of verbs.
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
    """Return the verbs that a plug-in offers, except verbs in a group, such as `check splits`."""
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
    "all_versions",
    is_flag=True,
    help="With --version: also the versions of Python and all libraries.",
)
@click.pass_context
def deepaccident(context: click.Context, version: bool, all_versions: bool) -> None:
    """Tools for the DeepAccident V2X accident dataset."""
    if version:
        click.echo(_versions() if all_versions else f"deepaccident, version {__version__}")
        context.exit()
    if all_versions:
        raise click.UsageError("--all needs --version")


def _versions() -> str:
    """Return the versions that a bug report needs.

    They are the versions of the devkit, Python, the system and each library of any extra.
    """
    # here, since it takes longer to import than everything else
    from importlib.metadata import PackageNotFoundError, requires, version

    from deepaccident_devkit.support.text import columns_text

    def installed(name: str) -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return "not installed"

    names = set()
    for requirement in requires("deepaccident_devkit") or ():
        match = re.match(r"[\w.-]+", requirement)
        if match and not _DEVELOPER_EXTRA.search(requirement):
            names.add(match.group().lower())
    rows = [
        ("deepaccident", __version__),
        ("Python", platform.python_version()),
        ("system", platform.platform()),
    ]
    rows += [(name, installed(name)) for name in sorted(names)]
    return columns_text(rows)


def main() -> None:
    """Run the command line; errors that the user can fix become one message and exit status 2."""
    # figures open no window and no file of the user changes them, in worker processes too
    os.environ |= {"MPLBACKEND": "Agg", "MATPLOTLIBRC": os.devnull}
    with lasting_streams():
        _run()


def _run() -> None:
    handler = logging.StreamHandler()
    # errors of dask also come as exceptions
    handler.addFilter(lambda record: record.name.partition(".")[0] not in _DASK_LOGGERS)
    logging.basicConfig(
        level=logging.WARNING, format="%(levelname)s: %(message)s", handlers=[handler]
    )
    try:
        run_interruptibly(deepaccident)
    except (DeepAccidentError, OSError, MemoryError) as error:
        # an OSError is a full disk, or a folder without permission; a loader's worker puts its
        # traceback before the message
        *_, message = str(error).rpartition(f".{type(error).__name__}: ")
        if isinstance(error, MemoryError):
            message = "memory ran out; use fewer workers (--workers), or a machine with more memory"
        click.echo(f"error: {message}", err=True)
        sys.exit(_FINDINGS_STATUS if isinstance(error, SomeFailedError) else _ERROR_STATUS)
