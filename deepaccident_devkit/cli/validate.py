"""`deepaccident validate`: faults, oddities and missing files of a release."""

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
    help="Folder to keep what is found in each scenario: the same command then goes on, and "
    "several share the work.",
)
@click.option(
    "--files",
    is_flag=True,
    help="Only list folders: how many scenarios are whole, and how many files of each split, "
    "agent and sensor are missing.",
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
    "all_findings",
    is_flag=True,
    help="List all findings of each scenario, not only the first eight, and notes, which are no "
    "errors or warnings.",
)
@json_parameter
def validate(
    dataroot: Dataroot,
    scenarios: tuple[str, ...],
    files: bool,
    all_findings: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Print what is wrong, unusual or missing in the release in DATAROOT, worst scenario first.

    The command reads the files and each scenario, and says where the index is out of date. Archives
    that cannot be read are listed, and left out. The report ends with the files that are missing.
    Exit status 0: there are only notes and known findings of the real release. 1: there are errors
    or other warnings. 2: the release cannot be read, or has no file to compare. With --files: 1 if
    an archive cannot be read, otherwise 0.
    """
    options |= {"scenarios": scenarios or None, "progress": sys.stderr.isatty()}
    if files:
        refuse_unused("with --files, which opens no file", "deep", "all_findings", "parts")
        del options["deep"], options["parts"]
        completeness = release_completeness(dataroot, **options)
        click.echo(completeness.to_json() if as_json else completeness.to_text())
        sys.exit(1 if completeness.unreadable_archives else 0)
    if as_json:
        refuse_unused("with --json, which has all findings and notes", "all_findings")
    report = validate_release(dataroot, **options)
    click.echo(
        report.to_json() if as_json else report.to_text(notes=all_findings, whole=all_findings)
    )
    sys.exit(report.exit_status)
