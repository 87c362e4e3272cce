"""`deepaccident explain`: one file of the release in words."""

from pathlib import Path

import click

from deepaccident_devkit.release import explain_file


@click.command(short_help="Print one file with each value's name, unit and frame.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--rows",
    type=click.IntRange(min=0),
    default=10,
    show_default=True,
    help="How many boxes of a label to list; 0 for all.",
)
def explain(file: Path, rows: int) -> None:
    """Print what FILE says, each value with its name, its unit and its frame.

    FILE is a label or meta file (.txt), a calib file (.pkl), or a LiDAR or BEV camera array (.npz). It may lie
    anywhere: the content tells which kind it is. Values are shown as the file has them (CARLA,
    left-handed), and where the devkit makes something else of them, that too. No code that a pickle holds is run.

    Of a broken label the lines before the wrong one are explained, then the error names that line. Exit status: 0 if
    the file is good, 2 if it is broken or of another kind.
    """
    explanation = explain_file(file, rows=rows or None)
    click.echo(explanation.text)
    if explanation.fault is not None:
        raise explanation.fault
