"""`deepaccident results`: results files, made from the output of other tools."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import DATAROOT, PATH, refuse_unused, release_options
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.support.text import counted

_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@verb()
@click.argument("file", type=_FILE)
@click.argument("dataroot", type=DATAROOT, required=False)
@click.option(
    "--truth", type=_FILE, metavar="FILE", help="truth.jsonl of the export of the questions."
)
@release_options
@click.option(
    "--threshold",
    type=click.FloatRange(0, 1),
    default=0.5,
    show_default=True,
    help="With --truth: probability from which a second is an alarm; 0 keeps all alarms, for "
    "curves.",
)
@click.option(
    "--method",
    metavar="TEXT",
    help="With --truth: name of the model, which the file and reports show.",
)
@click.option("--out", required=True, type=PATH, metavar="FILE", help="Results file to write.")
def results(
    file: Path, truth: Path | None, out: Path, threshold: float, method: str | None, **release: Any
) -> None:
    """Make a results file of what a model of another framework predicts.

    With DATAROOT, FILE has detections of a nuScenes export of that release: the JSON of a detector,
    as the nuScenes devkit reads it. Boxes of classes that DeepAccident does not have are left out.
    `deepaccident evaluate detection --samples all` evaluates what this writes.

    With --truth, FILE has answers to the questions of `deepaccident export questions`, one a line,
    as README.md beside the questions describes. A question without an answer raises no alarm.
    `deepaccident evaluate accident` and `deepaccident evaluate warning` take what this writes.
    """
    if (truth is None) == (release["dataroot"] is None):
        raise click.UsageError(
            "give DATAROOT for detections of a nuScenes export, or --truth for answers to questions"
        )
    if truth is None:
        refuse_unused("without --truth", "threshold", "method")
        _convert_detections(file, out, release)
    else:
        refuse_unused("with --truth", "version", "index_dir", "on_error", "workers", "scheduler")
        _convert_answers(file, truth, out, threshold, {} if method is None else {"method": method})


def _convert_detections(file: Path, out: Path, release: dict[str, Any]) -> None:
    from deepaccident_devkit.deepaccident import DeepAccident
    from deepaccident_devkit.evaluation.results import ResultsWriter
    from deepaccident_devkit.export.nuscenes.detections import results_from_nuscenes

    ResultsWriter(out, "detection")  # raises if the path exists, before the release is indexed
    detections = results_from_nuscenes(DeepAccident(**release), file)
    with ResultsWriter(out, "detection", meta=detections.meta) as writer:
        for token, boxes in detections.boxes.items():
            writer.add(token, boxes)
    box_count = sum(map(len, detections.boxes.values()))
    samples = counted(len(detections.boxes), "sample")
    click.echo(f"{out}: {box_count:,} boxes of {samples}")
    for name, count in detections.left_out.items():
        click.echo(
            f"left out: {count:,} boxes of the class {name}, which DeepAccident does not have"
        )


def _convert_answers(
    file: Path, truth: Path, out: Path, threshold: float, meta: dict[str, str]
) -> None:
    from deepaccident_devkit.export.questions import results_of_answers

    read = results_of_answers(file, truth, out, threshold=threshold, meta=meta)
    click.echo(f"{out}: {read.alarms:,} alarms in {read.answered:,} answers")
    if read.missing:
        click.echo(f"without an answer: {len(read.missing):,} questions, which raise no alarm")
