"""`deepaccident split`: the official split, made again, or the scenarios that match filters."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    json_parameter,
    refuse_unused,
    release_parameters,
    where_parameter,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.selection.splits import (
    OFFICIAL_SEED,
    official_split,
    save_selection,
    split_report,
)


@verb()
@release_parameters
@click.option(
    "--seed", default=OFFICIAL_SEED, show_default=True, help="Seed of the official procedure."
)
@click.option(
    "--out",
    type=PATH,
    help="Folder to write train.txt, val.txt, test.txt, train_mini.txt and val_mini.txt into; or "
    "a file that ends in .txt: a split file of the scenarios that match --where, or of all.",
)
@where_parameter
@click.option("--overwrite", is_flag=True, help="Replace files that already exist.")
@json_parameter
def split(
    seed: int,
    out: Path | None,
    where: tuple[str, ...],
    overwrite: bool,
    as_json: bool,
    **release: Any,
) -> None:
    """Split the release in DATAROOT by the official procedure, and print how scenarios are spread.

    With --where, report only the scenarios that match all filters.
    """
    save = out if out is not None and out.suffix == ".txt" else None
    if where and out and not save:
        raise click.UsageError(
            f"--where chooses scenarios for a split file; give --out FILE.txt, found {out}"
        )
    if where or save:
        refuse_unused("with --where or a split file: it is for the official split", "seed")
    if not out:
        refuse_unused("without --out", "overwrite")
    dataset = DeepAccident(**release)
    if where or save:
        tokens = [scenario["token"] for scenario in dataset.find(*where)]
        written = [save_selection(tokens, save, overwrite=overwrite)] if save else []
        report = split_report(dataset, {"selection": tokens})
    else:
        splits = official_split(dataset, seed)
        written = splits.save(out, overwrite=overwrite) if out else []
        report = split_report(dataset, splits)
    click.echo(report.to_json() if as_json else report.to_text())
    for path in written:
        click.echo(f"written: {path}", err=as_json)
