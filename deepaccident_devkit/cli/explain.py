"""`deepaccident explain`: one file of the release in words."""

from pathlib import Path

import click

from deepaccident_devkit.cli.options import refuse_unused
from deepaccident_devkit.release import explain_file


@click.command(short_help="Print one file with each value's name, unit and coordinate frame.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--rows",
    type=click.IntRange(min=0),
    default=10,
    show_default=True,
    help="How many boxes of a label to list; 0 for all.",
)
def explain(file: Path, rows: int) -> None:
    """Print the values of FILE, each with its name, its unit and its coordinate frame.

    FILE is a label or meta file (.txt), a calib file (.pkl), or a LiDAR or BEV camera array (.npz). It may lie
    anywhere: the command finds the kind from the content. Values are shown as in the file (CARLA, left-handed);
    those that the devkit converts are shown converted as well. Code in a pickle is never run.

    If a label is broken, the command explains the lines before the wrong line, and the error names that line. Exit
    status: 0 if the file is good, 2 if it is broken or of another kind.
    """
    explanation = explain_file(file, rows=rows or None)
    if explanation.kind != "label":
        refuse_unused(f"for a file of the kind {explanation.kind}", "rows")
    click.echo(explanation.text)
    if explanation.fault is not None:
        raise explanation.fault
