"""`deepaccident validate`: what is wrong, odd or missing in a release."""

import sys
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.validation import validate_release

_FINDINGS_STATUS = 1


@click.command()
@release_parameters
@click.option("--deep", is_flag=True, help="Decode every image and array, and hold them against the labels.")
@click.option("--scenario", "scenarios", multiple=True, metavar="TOKEN", help="Only this scenario; may be repeated.")
@click.option("--notes", is_flag=True, help="List also what is only worth knowing.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document, for programs.")
def validate(
    dataroot: Path, version: str, deep: bool, scenarios: tuple[str, ...], notes: bool, as_json: bool, **release: Any
) -> None:
    """Say what is wrong, odd or missing in the release under DATAROOT, worst scenario first.

    It reads the files, not the index, and looks at every scenario: --index-dir and --on-error change nothing here.
    Exit status: 0 if there are at most notes and what the real release is known for, 1 if there are errors or other
    warnings, 2 if it cannot be looked at.
    """
    report = validate_release(
        dataroot,
        version,
        deep=deep,
        workers=release["workers"],
        scenarios=scenarios or None,
        progress=sys.stderr.isatty(),
    )
    click.echo(report.to_json() if as_json else report.to_text(notes=notes))
    if not report.is_good:
        sys.exit(_FINDINGS_STATUS)
