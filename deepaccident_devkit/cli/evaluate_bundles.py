"""`deepaccident evaluate check|verify|compare`: check results; repeat or compare evaluations."""

import json
import sys
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.evaluate_options import resamples_parameter, selection_of, selection_parameters
from deepaccident_devkit.cli.options import (
    DATAROOT,
    WordChoice,
    engine_of,
    engine_parameters,
    on_error_parameter,
    refuse_unused,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import compare_bundles, coverage, read_bundle, results_text, verify_bundle
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.runs.verification import check_repeated
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.render.evaluation import render_comparison
from deepaccident_devkit.render.pictures import PICTURE_SUFFIXES, save_picture
from deepaccident_devkit.tables import place_outside
from deepaccident_devkit.taxonomy import VERSIONS, OnError

_FINDINGS_STATUS = 1
_OF_RELEASE = ("version", "split", "samples", "scope", "agents", "horizon", "on_error")
_KINDS = (".csv", ".json", *PICTURE_SUFFIXES)
_DPI = 130


@click.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.option("--dataroot", type=DATAROOT, help="Also compare the samples with those of this release.")
@click.option("--version", type=WordChoice(VERSIONS), default="v1", show_default=True, help="Version of the release.")
@selection_parameters
@engine_parameters
@on_error_parameter
def check(results: Path, dataroot: Dataroot | None, version: str, **options: Any) -> None:
    """Check every entry of the results file or folder RESULTS, and print a summary.

    With --dataroot, also repeat the warnings of `evaluate … --sanity`.
    Exit status 1: with --dataroot, samples of --split are missing, or RESULTS has others. 2: an entry is wrong.
    """
    if dataroot is None:
        refuse_unused("without --dataroot", *_OF_RELEASE)
    opened, engine = read_results(results), engine_of(options)
    opened.check(**engine, progress=True)
    click.echo(results_text(opened))
    if dataroot is None:
        return
    dataset = DeepAccident(version, dataroot, on_error=options["on_error"], **engine)
    protocol = "boxes" if opened.task == "accident" else "released"  # the one that takes explicit accidents
    setup = EvaluationSetup(task=opened.task, protocol=protocol, horizon=options["horizon"])
    selection = selection_of(setup, options)
    covered = coverage(dataset, opened.tokens, selection)
    click.echo(f"{selection.text()}: {covered.to_text()}")
    shared = sorted(set(opened.tokens).intersection(selection.tokens(dataset)))
    warnings = check_sanity(dataset, opened, setup, shared, **engine).warnings_text() if shared else ""
    if warnings:
        click.echo(warnings)
    if not covered.is_complete:
        sys.exit(_FINDINGS_STATUS)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--dataroot", type=DATAROOT, help="Folder of the release; without it, nothing is done.")
@click.option(
    "--results", type=click.Path(path_type=Path), help="Results file or folder.  [default: the copy in DIR, if any]"
)
@click.option("--split", help="Split file, if the evaluation in DIR is of one.")
@click.option(
    "--index-dir",
    type=click.Path(path_type=Path),
    help="Folder of the index.  [default: as it is, or else in the user's cache]",
)
@engine_parameters
@on_error_parameter
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def verify(
    folder: Path,
    dataroot: Dataroot | None,
    results: Path | None,
    split: str | None,
    index_dir: Path | None,
    on_error: OnError,
    as_json: bool,
    **engine: Any,
) -> None:
    """Repeat the evaluation in the folder DIR and list all differences.

    DIR may come from anyone: paths that it names are opened only if you give them, as the error says; links in it are
    not followed; nothing is written into the release.

    Exit status 0: there is no difference. 1: there are differences. 2: nothing could be compared.
    """
    bundle = read_bundle(folder)
    check_repeated(bundle, {"dataroot": dataroot, "results": results, "split": split})
    layout = find_release(open_dataroot(dataroot or bundle.dataroot, index_dir, outside=True), bundle.release_version)
    place = index_dir or place_outside(layout)
    dataset = DeepAccident(layout.version, layout.root, place, on_error=on_error, **engine)
    verification = verify_bundle(folder, dataset, results=results, split=split, progress=True, **engine)
    click.echo(json.dumps(verification.as_dict(), indent=1) if as_json else verification.to_text())
    if not verification.is_same:
        sys.exit(_FINDINGS_STATUS)


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--common", is_flag=True, help="Compare only the samples that both evaluations have.")
@resamples_parameter
@click.option(
    "--out",
    multiple=True,
    type=click.Path(path_type=Path),
    help="File to write all numbers into (.csv or .json), or a figure of the differences "
    f"({', '.join(PICTURE_SUFFIXES)}); you can repeat this option.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for programs.")
def compare(a: Path, b: Path, common: bool, resamples: int, out: tuple[Path, ...], as_json: bool) -> None:
    """Compare the evaluations in the folders A and B, and test which differences are statistically significant."""
    for path in out:
        if path.suffix.lower() not in _KINDS:
            raise click.BadParameter(f"--out: expected a file that ends in {', '.join(_KINDS)}, found {str(path)!r}")
    comparison = compare_bundles(a, b, Resampling(resamples=resamples), common=common)
    as_text = json.dumps(comparison.as_dict(), indent=1)
    for path in out:
        if path.suffix.lower() == ".csv":
            comparison.to_csv(path)
        elif path.suffix.lower() == ".json":
            write_bytes(path, as_text.encode())
        else:
            save_picture(render_comparison(comparison), path, dpi=_DPI)
    click.echo(as_text if as_json else comparison.to_text())
    for path in out:
        click.echo(f"written: {path}", err=as_json)
