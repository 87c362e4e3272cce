"""`deepaccident validate`: faults, oddities and missing files of a release."""

import sys
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    dataroot_argument,
    engine_parameters,
    json_parameter,
    print_report,
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
    help="Keep the findings of each scenario in this folder. The same command then continues an "
    "interrupted run, and several commands can share the work.",
)
@click.option(
    "--files",
    is_flag=True,
    help="Only list the folders, and open no file: print how many scenarios are complete, and how "
    "many files of each split, agent and sensor are missing.",
)
@click.option(
    "--deep",
    is_flag=True,
    help="Also decode every image and array, and compare them with the labels.",
)
@click.option(
    "--scenario",
    "scenarios",
    multiple=True,
    metavar="TOKEN",
    help="Validate only this scenario. You can repeat this option.",
)
@click.option(
    "--all",
    "all_findings",
    is_flag=True,
    help="List all findings of each scenario instead of the first eight, including notes, which "
    "are neither errors nor warnings.",
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
    """Report what is wrong, unusual or missing in the release in DATAROOT, worst scenario first.

    The command checks every scenario, and also reports an outdated index. Archives that cannot be
    read are listed, and the check goes on without them. The report ends with the missing files.

    The command exits with 0 if there are only notes and known findings of the real release, with 1
    if there are errors or other warnings, and with 2 if the release cannot be read or contains
    nothing to check. With --files, it exits with 1 if an archive cannot be read, otherwise with 0.
    """
    options |= {"scenarios": scenarios or None, "progress": sys.stderr.isatty()}
    if files:
        refuse_unused("with --files, which opens no file", "deep", "all_findings", "parts")
        del options["deep"], options["parts"]
        completeness = release_completeness(dataroot, **options)
        print_report(completeness, as_json=as_json)
        sys.exit(1 if completeness.unreadable_archives else 0)
    if as_json:
        refuse_unused("with --json, which always prints all findings and notes", "all_findings")
    report = validate_release(dataroot, **options)
    if as_json:
        click.echo(report.to_json())
    else:
        click.echo(report.to_text(notes=all_findings, whole=all_findings))
    sys.exit(report.exit_status)
