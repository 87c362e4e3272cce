"""`deepaccident split`: recomputes the official split, or lists scenarios that match filters."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    PATH,
    json_parameter,
    print_report,
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
    help="Write train.txt, val.txt, test.txt, train_mini.txt and val_mini.txt into this folder. If "
    "the name ends in .txt, write one split file with the scenarios that match --where, or with "
    "all scenarios.",
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
    """Split the release in DATAROOT by the official procedure, and print a table of the splits.

    With --where, report only the scenarios that match all filters.
    """
    split_file = out if out is not None and out.suffix == ".txt" else None
    if where and out and not split_file:
        raise click.UsageError(
            f"--where selects scenarios for a split file; give --out FILE.txt, found {out}"
        )
    if where or split_file:
        refuse_unused("with --where or a split file, which are not the official split", "seed")
    if not out:
        refuse_unused("without --out", "overwrite")
    dataset = DeepAccident(**release)
    written_files = []
    if where or split_file:
        tokens = [scenario["token"] for scenario in dataset.find(*where)]
        if split_file:
            written_files = [save_selection(tokens, split_file, overwrite=overwrite)]
        report = split_report(dataset, {"selection": tokens})
    else:
        splits = official_split(dataset, seed)
        if out:
            written_files = splits.save(out, overwrite=overwrite)
        report = split_report(dataset, splits)
    print_report(report, as_json=as_json)
    for path in written_files:
        click.echo(f"wrote {path}", err=as_json)
