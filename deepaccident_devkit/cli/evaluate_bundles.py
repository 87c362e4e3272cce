"""`deepaccident check bundle` and `evaluate compare`: repeat an evaluation, or compare two."""

import sys
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.options import (
    DATAROOT,
    PATH,
    engine_parameters,
    figure_style_parameter,
    index_dir_parameter,
    json_parameter,
    on_error_parameter,
    print_report,
)
from deepaccident_devkit.cli.verbs import advanced, field_option, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.intervals import MAX_RESAMPLES
from deepaccident_devkit.evaluation.runs import (
    Comparison,
    OverBytes,
    SideBySide,
    compare_bundles,
    over_bytes,
    read_bundle,
    side_by_side,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.verification import check_repeated
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.render.evaluation import render_comparison, render_over_bytes
from deepaccident_devkit.render.figures import PICTURE_SUFFIXES, save_picture
from deepaccident_devkit.render.styles import current_style
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reports import write_csv
from deepaccident_devkit.tables import choose_outside_index_dir
from deepaccident_devkit.taxonomy import OnError

_FINDINGS_STATUS = 1
_SUFFIXES = (".csv", ".json", *PICTURE_SUFFIXES)
_DPI = 130


@verb("bundle")
@click.argument("folder", metavar="DIR", type=PATH)
@click.option("--dataroot", type=DATAROOT, help="Folder of the release; the command needs it.")
@click.option("--results", type=PATH, help="Results file or folder.  [default: the copy in DIR]")
@click.option("--split", help="Split file, if the evaluation in DIR used one.")
@index_dir_parameter
@engine_parameters
@on_error_parameter
@json_parameter
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

    You need not trust the author of DIR: the command opens only the paths that you give, follows no
    links in DIR, and writes nothing into the release.

    It exits with 0 if there is no difference, with 1 if there are differences, and with 2 if
    nothing could be compared.
    """
    bundle = read_bundle(folder)
    check_repeated(bundle, {"dataroot": dataroot, "results": results, "split": split})
    root = open_dataroot(dataroot or bundle.dataroot, index_dir, outside=True, on_error=on_error)
    layout = find_release(root, bundle.release_version)
    index_path = index_dir or choose_outside_index_dir(layout)
    dataset = DeepAccident(layout.version, layout.root, index_path, on_error=on_error, **engine)
    verification = verify_bundle(
        folder, dataset, results=results, split=split, progress=True, **engine
    )
    print_report(verification, as_json=as_json)
    if not verification.is_same:
        sys.exit(_FINDINGS_STATUS)


@verb()
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@click.argument("more", type=PATH, nargs=-1)
@click.option("--common", is_flag=True, help="Compare only the samples that all evaluations have.")
@field_option(Resampling, "resamples", option=advanced, type=click.IntRange(0, MAX_RESAMPLES))
@click.option(
    "--out",
    multiple=True,
    type=PATH,
    help="Write all numbers to this file (.csv or .json), or draw a figure "
    f"({', '.join(PICTURE_SUFFIXES)}). You can repeat this option.",
)
@figure_style_parameter
@json_parameter
def compare(
    a: Path,
    b: Path,
    more: tuple[Path, ...],
    common: bool,
    resamples: int,
    out: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Compare the evaluations in the folders A and B, and test which differences are significant.

    With MORE evaluations, show the main numbers of all evaluations over the bytes that partners
    send. Evaluations that have no scenario in common, such as those of different datasets, are
    shown side by side, each by its own rules.
    """
    for path in out:
        if path.suffix.lower() not in _SUFFIXES:
            raise click.BadParameter(
                f"--out: expected a file that ends in {', '.join(_SUFFIXES)}, found {str(path)!r}"
            )
    comparison: SideBySide | OverBytes | Comparison
    bundles = [read_bundle(folder) for folder in (a, b, *more)]
    are_disjoint = False
    if not common:
        scenario_sets = [set(bundle.scenarios()) for bundle in bundles]
        are_disjoint = not set.intersection(*scenario_sets)
    if are_disjoint:
        comparison = side_by_side(bundles)
        if any(path.suffix.lower() in PICTURE_SUFFIXES for path in out):
            raise click.BadParameter(
                "--out: these evaluations have no sample in common; give a .csv or .json file"
            )
    elif more:
        comparison = over_bytes([a, b, *more], Resampling(resamples=resamples), common=common)
    else:
        comparison = compare_bundles(a, b, Resampling(resamples=resamples), common=common)
    for path in out:
        _write_comparison(comparison, path)
    print_report(comparison, as_json=as_json)
    for path in out:
        click.echo(f"wrote {path}", err=as_json)


def _write_comparison(comparison: SideBySide | OverBytes | Comparison, path: Path) -> None:
    """Write a comparison to a file, in the format that the file's suffix means."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        write_csv(path, comparison.named_tables()["numbers"])
    elif suffix == ".json":
        write_bytes(path, comparison.to_json().encode())
    else:
        draw: Any = render_over_bytes if isinstance(comparison, OverBytes) else render_comparison
        dpi = None if current_style().shows_few_panels else _DPI
        save_picture(draw(comparison), path, dpi=dpi)
