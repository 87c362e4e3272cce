"""The command line `deepaccident`: one module per subcommand; plug-ins add further subcommands.

A subcommand parses its arguments, makes one library call and prints the result. Exit status: 0
success, 1 findings, 2 error; 130 after Ctrl-C, 143 after SIGTERM, 141 if the reader of the output
has gone away.
"""

import io
import logging
import os
import platform
import re
import sys
import warnings
from functools import partial
from importlib import import_module

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
_DEVELOPER_EXTRA = re.compile(r"extra == .(test|lint|docs)\b")
# Core subcommand, with a module of the same name → its line in the list of subcommands.
_SUMMARIES = {
    "check": "Check a release, an index, results, an evaluation, splits or a reader.",
    "cache": "Write resized images for training.",
    "evaluate": "Evaluate results files; compare evaluations.",
    "export": "Export data to the formats of other tools.",
    "index": "Create, update or remove the index of a release.",
    "info": "Show what a release contains, and its statistics.",
    "labels": "Write the motion labels of a split.",
    "render": "Render pictures, videos and replays.",
    "results": "Convert the output of other tools into results files.",
    "split": "Make the official splits, or a split file of your own.",
    "validate": "Report what is wrong, unusual or missing in a release.",
}


def _load_core_verb(name: str) -> click.Command:
    verb: click.Command = getattr(import_module(f"{__name__}.{name}"), name)
    return verb


def _read_plugin_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the subcommands of a plug-in, except for subcommands of a group (`check splits`)."""
    return {name: verb for name, verb in plugin.verbs.items() if " " not in name}


_VERBS = {
    name: LazyVerb(summary, partial(_load_core_verb, name)) for name, summary in _SUMMARIES.items()
}


@click.group(
    cls=LazyVerbs,
    verbs=_VERBS,
    read_plugin=_read_plugin_verbs,
    invoke_without_command=True,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option("--version", is_flag=True, help="Show the version and exit.")
@click.option(
    "--all",
    "all_versions",
    is_flag=True,
    help="With --version: also show the versions of Python and all libraries.",
)
@click.pass_context
def deepaccident(context: click.Context, version: bool, all_versions: bool) -> None:
    """Tools for the DeepAccident V2X accident dataset."""
    if version:
        versions = f"deepaccident, version {__version__}"
        if all_versions:
            versions = _list_versions()
        click.echo(versions)
        context.exit()
    if all_versions:
        raise click.UsageError("--all requires --version")


def _list_versions() -> str:
    """Return a table of the versions that a bug report needs.

    It contains the devkit, Python, the system, and each library that any extra requires.
    """
    # imported here because it takes longer to import than everything else
    from importlib.metadata import PackageNotFoundError, requires, version

    from deepaccident_devkit.support.text import columns_text

    def find_version(name: str) -> str:
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
    rows += [(name, find_version(name)) for name in sorted(names)]
    return columns_text(rows)


def main() -> None:
    """Run the command line; an error that the user can fix prints a message and exits with 2."""
    # figures open no windows and ignore the user's style files, also in worker processes
    os.environ |= {"MPLBACKEND": "Agg", "MATPLOTLIBRC": os.devnull}
    with lasting_streams():
        _run_command()


def _run_command() -> None:
    handler = logging.StreamHandler()
    # errors in dask also arrive here as exceptions
    handler.addFilter(lambda record: record.name.partition(".")[0] not in _DASK_LOGGERS)
    logging.addLevelName(logging.WARNING, "warning")
    logging.basicConfig(
        level=logging.WARNING, format="%(levelname)s: %(message)s", handlers=[handler]
    )
    warnings.showwarning = lambda message, *_: click.echo(f"warning: {message}", err=True)
    try:
        run_interruptibly(partial(deepaccident, standalone_mode=False))
    except click.ClickException as error:
        text = io.StringIO()
        error.show(text)
        # our own errors begin in lower case
        message = re.sub("^Error: ", "error: ", text.getvalue(), count=1, flags=re.MULTILINE)
        click.echo(message, nl=False, err=True)
        sys.exit(error.exit_code)
    except (DeepAccidentError, OSError, MemoryError) as error:
        # an OSError is a full disk or a folder without permission; a data loader's worker puts its
        # traceback before the message
        message = str(error).rpartition(f".{type(error).__name__}: ")[2]
        if isinstance(error, MemoryError):
            message = "out of memory; use fewer workers (--workers), or a machine with more memory"
        click.echo(f"error: {message}", err=True)
        if isinstance(error, SomeFailedError):
            sys.exit(_FINDINGS_STATUS)
        sys.exit(_ERROR_STATUS)
