"""The command line: `deepaccident <verb>`, one module for each verb.

A verb parses, makes one library call and prints. Exit status: 0 good, 1 findings, 2 error.
"""

import logging
import sys

import click

from deepaccident_devkit._version import __version__
from deepaccident_devkit.cli.groups import ModuleVerbs
from deepaccident_devkit.errors import DeepAccidentError

_ERROR_STATUS = 2


_VERBS = (
    "demo",
    "synth",
    "index",
    "info",
    "explain",
    "labels",
    "split",
    "stats",
    "validate",
    "evaluate",
    "baseline",
    "render",
    "replay",
    "export",
)


@click.group(
    cls=ModuleVerbs,
    package=__name__,
    verbs=_VERBS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="deepaccident")
def deepaccident() -> None:
    """Tools for the DeepAccident V2X accident dataset."""


def main() -> None:
    """Run the command line; errors that the user can mend become one message and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        deepaccident()
    except (DeepAccidentError, OSError) as error:  # an OSError: a full disk, a folder without permission
        click.echo(f"error: {error}", err=True)
        sys.exit(_ERROR_STATUS)
