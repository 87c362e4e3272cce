"""`deepaccident results`: makes results files from the output of other tools."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import DATAROOT, PATH, refuse_unused, release_options
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues

_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@verb()
@click.argument("file", type=_FILE)
@click.argument("dataroot", type=DATAROOT, required=False)
@click.option(
    "--truth", type=_FILE, metavar="FILE", help="The file truth.jsonl of the exported questions."
)
@release_options
@click.option(
    "--threshold",
    type=click.FloatRange(0, 1),
    default=0.5,
    show_default=True,
    help="With --truth: minimum probability of an alarm; 0 keeps all alarms, as curves need.",
)
@click.option(
    "--method",
    metavar="TEXT",
    help="With --truth: name of the model in the results file and in reports.",
)
@click.option("--out", required=True, type=PATH, metavar="FILE", help="Results file to write.")
def results(
    file: Path, truth: Path | None, out: Path, threshold: float, method: str | None, **release: Any
) -> None:
    """Convert the predictions of a model from another framework into a results file.

    With DATAROOT, FILE contains detections on a nuScenes export of that release, as JSON in the
    format of the nuScenes devkit. Boxes of classes that DeepAccident does not have are excluded.
    Evaluate the results file with `deepaccident evaluate detection --samples all`.

    With --truth, FILE contains answers to the questions of `deepaccident export questions`, one per
    line; the README.md next to the questions describes their format. A question without an answer
    raises no alarm. Evaluate the results file with `deepaccident evaluate accident` or with
    `deepaccident evaluate warning`.
    """
    if (truth is None) == (release["dataroot"] is None):
        raise click.UsageError(
            "give DATAROOT for detections on a nuScenes export, or --truth for answers to questions"
        )
    if truth is None:
        refuse_unused("without --truth", "threshold", "method")
        _convert_detections(file, out, release)
    else:
        refuse_unused("with --truth", "version", "index_dir", "on_error", "workers", "scheduler")
        _convert_answers(file, truth, out, threshold, {} if method is None else {"method": method})


def _convert_detections(file: Path, out: Path, release: NamedValues) -> None:
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
    click.echo(f"wrote {out} ({samples}, {counted(box_count, 'box')})")
    for name, count in detections.left_out.items():
        excluded = counted(count, "box")
        click.echo(f"excluded: {excluded} of class {name}, which DeepAccident does not have")


def _convert_answers(
    file: Path, truth: Path, out: Path, threshold: float, meta: dict[str, str]
) -> None:
    from deepaccident_devkit.export.questions import results_of_answers

    answers = results_of_answers(file, truth, out, threshold=threshold, meta=meta)
    alarms = counted(answers.alarms, "alarm")
    answered = counted(answers.answered, "answer")
    click.echo(f"wrote {out} ({alarms} in {answered})")
    if answers.missing:
        questions = counted(len(answers.missing), "question")
        click.echo(f"warning: {questions} without an answer, counted as no alarm", err=True)
