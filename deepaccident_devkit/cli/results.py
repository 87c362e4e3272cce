"""`deepaccident results`: results files, made of those of other tools."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.export.nuscenes.detections import results_from_nuscenes
from deepaccident_devkit.export.questions import results_of_answers


@click.group()
def results() -> None:
    """Make results files of what models of other frameworks predict."""


@results.group("from")
def from_() -> None:
    """Convert predictions of other tools."""


@from_.command()
@click.argument("file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@release_parameters
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Results file to write.")
def nuscenes(file: Path, out: Path, **options: Any) -> None:
    """Convert detections of a nuScenes export of the release in DATAROOT.

    FILE is the JSON of a detector, as the nuScenes devkit reads it. Boxes of classes that DeepAccident does not have
    are left out. `deepaccident evaluate detection --samples all` evaluates what this writes.
    """
    ResultsWriter(out, "detection")  # refuses a path that is taken, before the release is indexed
    found = results_from_nuscenes(DeepAccident(**options), file)
    with ResultsWriter(out, "detection", meta=found.meta) as writer:
        for token, boxes in found.boxes.items():
            writer.add(token, boxes)
    click.echo(f"{out}: {sum(map(len, found.boxes.values())):,} boxes of {len(found.boxes):,} samples")
    for name, count in found.left_out.items():
        click.echo(f"left out: {count:,} boxes of the class {name}, which DeepAccident does not have")


@from_.command()
@click.argument("file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option(
    "--truth",
    required=True,
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="truth.jsonl of the export of the questions.",
)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Results file to write.")
@click.option(
    "--threshold",
    type=click.FloatRange(0, 1),
    default=0.5,
    show_default=True,
    help="Probability from which a second is an alarm; 0 keeps all alarms, for curves.",
)
@click.option("--method", metavar="TEXT", help="Name of the model, which the results file and reports show.")
def questions(file: Path, truth: Path, out: Path, threshold: float, method: str | None) -> None:
    """Convert answers to the questions of `deepaccident export questions`.

    FILE holds an answer a line, as README.md beside the questions says. A question without an answer raises no alarm.
    `deepaccident evaluate accident` and `deepaccident evaluate warning` take what this writes.
    """
    meta = {} if method is None else {"method": method}
    read = results_of_answers(file, truth, out, threshold=threshold, meta=meta)
    click.echo(f"{out}: {read.alarms:,} alarms in {read.answered:,} answers")
    if read.missing:
        click.echo(f"without an answer: {len(read.missing):,} questions, which raise no alarm")
