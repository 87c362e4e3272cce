"""`deepaccident validate`: what is wrong, odd or missing in a release."""

import sys
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    dataroot_argument,
    engine_parameters,
    json_parameter,
    refuse_unused,
    version_parameter,
)
from deepaccident_devkit.cli.verbs import advanced, verb
from deepaccident_devkit.release.store import Dataroot
from deepaccident_devkit.validation import release_completeness, validate_release


@verb()
@dataroot_argument
@version_parameter
@engine_parameters
@advanced(
    "--parts",
    type=PATH,
    metavar="FOLDER",
    help="Folder to keep what is found in each scenario: the same command then goes on, and several share the work.",
)
@click.option(
    "--files",
    is_flag=True,
    help="Only list folders: how many scenarios are whole, and how many files of each split, agent and sensor are "
    "missing.",
)
@click.option(
    "--deep",
    is_flag=True,
    help="Also decode each image and array, and compare them with the labels.",
)
@click.option(
    "--scenario",
    "scenarios",
    multiple=True,
    metavar="TOKEN",
    help="Only this scenario; you can repeat this option.",
)
@click.option(
    "--all",
    "whole",
    is_flag=True,
    help="List all findings of each scenario, not only the first eight, and notes, which are no errors or warnings.",
)
@json_parameter
def validate(
    dataroot: Dataroot,
    scenarios: tuple[str, ...],
    files: bool,
    whole: bool,
    as_json: bool,
    **how: Any,
) -> None:
    """Print what is wrong, unusual or missing in the release in DATAROOT, worst scenario first.

    The command reads the files and each scenario, and says where the index is out of date. Archives that cannot be
    read are listed, and left out. The report ends with the files that are missing.
    Exit status 0: there are only notes and known findings of the real release. 1: there are errors or other warnings.
    2: the release cannot be read, or has no file to compare. With --files: 1 if an archive cannot be read, else 0.
    """
    how |= {"scenarios": scenarios or None, "progress": sys.stderr.isatty()}
    if files:
        refuse_unused("with --files, which opens no file", "deep", "whole", "parts")
        del how["deep"], how["parts"]
        counted = release_completeness(dataroot, **how)
        click.echo(counted.to_json() if as_json else counted.to_text())
        sys.exit(1 if counted.unreadable_archives else 0)
    if as_json:
        refuse_unused("with --json, which has all findings and notes", "whole")
    report = validate_release(dataroot, **how)
    click.echo(report.to_json() if as_json else report.to_text(notes=whole, whole=whole))
    sys.exit(report.exit_status)
