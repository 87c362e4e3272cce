"""`verify_bundle`: recompute an evaluation from its results, and list what differs from what was written."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import DeepAccidentError, ResultsError
from deepaccident_devkit.evaluation.metrics.intervals import Resampling
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs.bundles import (
    COUNTS_FILE,
    FILES_FILE,
    ROWS_FILE,
    SCENARIOS_FILE,
    SUMMARY_FILE,
    Bundle,
    checksums_of,
    own_file,
    read_bundle,
    read_json,
)
from deepaccident_devkit.evaluation.runs.differences import ABSENT, Difference, differing
from deepaccident_devkit.evaluation.runs.evaluate import evaluate_results
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.runs.prevention import with_prevented
from deepaccident_devkit.evaluation.runs.rows import read_rows, sample_rows
from deepaccident_devkit.evaluation.runs.selection import SampleSelection
from deepaccident_devkit.files import path_of
from deepaccident_devkit.release.fingerprints import scenario_hashes

if TYPE_CHECKING:
    from concurrent.futures import Executor

_SHOWN: Final = 10
"""Differences of a kind that the text lists."""
_NOT_COMPARED: Final = (
    "devkit_version",
    "environment",
    "sanity",
    "release/dataroot",
    "results/path",
    "results/fingerprint",
)
"""Of a summary: what is distinguished, is not made again, or says where things were."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification(ShortRepr):
    """A bundle against its evaluation made again.

    Attributes:
        folder: of the bundle.
        samples: how many were evaluated again.
        differences: all that were found.
        notes: sentences on what could not differ, or does not matter.
    """

    folder: Path
    samples: int
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        return not self.differences

    def to_text(self) -> str:
        """A line a difference, the first of each kind, and how many more there are."""
        if self.is_same:
            head = f"{self.folder}: the same; {self.samples} samples evaluated again, all numbers are equal"
        else:
            head = f"{self.folder}: {len(self.differences)} differences; {self.samples} samples evaluated again"
        by_kind: dict[str, list[Difference]] = {}
        for each in self.differences:
            by_kind.setdefault(each.kind, []).append(each)
        lines = [head]
        for kind, those in by_kind.items():
            lines += [f"  {each.text()}" for each in those[:_SHOWN]]
            if len(those) > _SHOWN:
                lines.append(f"  {kind}: {len(those) - _SHOWN} more")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        return {
            "folder": os.fspath(self.folder),
            "same": self.is_same,
            "samples": self.samples,
            "differences": [each.as_dict() for each in self.differences],
            "notes": list(self.notes),
        }


def verify_bundle(
    folder: str | os.PathLike[str],
    dataset: Dataset,
    *,
    results: Results | str | os.PathLike[str] | None = None,
    split: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> Verification:
    """Evaluate again what a bundle is of, and compare everything with it; numbers must be equal to the bit.

    A bundle may come from anyone. So no path in it that leads out of it is opened (`Bundle.outside_paths`), and no link
    in it is followed; files that do not belong to it are named, not opened.

    Args:
        folder: of the bundle.
        dataset: the release; where `read_bundle(folder).dataroot` says, or another copy of it.
        results: the predictions; None for the bundle's own copy.
        split: the split file, if the bundle is of one; else None.
        workers: processes; None takes what the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show bars.

    Raises:
        ResultsError: there is no bundle of this devkit's format, no results to evaluate, or a path must be given.
    """
    bundle = read_bundle(path_of(folder))
    check_repeated(bundle, {"dataroot": dataset.dataroot, "results": results, "split": split})
    given = bundle.results_path if results is None else results
    opened = given if isinstance(given, Results) else read_results(given)
    engine = {"workers": workers, "executor": executor}
    found = [*_version(bundle), *_files(bundle), *_scenarios(bundle, dataset, engine), *_results(bundle, opened)]
    run: EvaluationRun | None = None
    try:
        selection = bundle.selection if split is None else replace(bundle.selection, split=os.fspath(split))
        run = _again(bundle, dataset, opened, selection, engine, progress=progress)
    except DeepAccidentError as error:
        found.append(Difference(kind="evaluation", where="all numbers", stored="evaluated", found=str(error)))
    if run is not None:
        found += chain(_numbers(bundle, run), _unlisted(bundle, run), _counts(bundle, run), _rows(bundle, run))
    return Verification(
        folder=bundle.folder,
        samples=0 if run is None else len(run.evaluator),
        differences=tuple(found),
        notes=tuple(_notes(bundle, run, found)),
    )


def check_repeated(bundle: Bundle, given: Mapping[str, object]) -> None:
    """Raise ResultsError unless all `Bundle.outside_paths` are given; it says how to give them as they are there."""
    outside = bundle.outside_paths()
    if all(given[name] is not None for name in outside):
        return
    options = " ".join(f"--{name} {shlex.quote(path)}" for name, path in outside.items())
    raise ResultsError(
        f"{bundle.folder}: names paths outside of it, which are opened only if you give them: deepaccident evaluate "
        f"verify {shlex.quote(os.fspath(bundle.folder))} {options}"
    )


def _again(
    bundle: Bundle,
    dataset: Dataset,
    results: Results,
    selection: SampleSelection,
    engine: Mapping[str, Any],
    *,
    progress: bool,
) -> EvaluationRun:
    run = evaluate_results(
        dataset,
        results,
        bundle.setup,
        selection,
        allow_partial=bundle.summary["partial"] is not None or bool(bundle.summary["counts"]["left_out"]),
        progress=progress,
        **engine,
    )
    breakdowns, prevented = bundle.summary["breakdowns"], bundle.summary.get("prevented")
    if breakdowns:
        run = run.broken_down(list(breakdowns), _resampling(next(iter(breakdowns.values()))), **engine)
    return run if prevented is None else with_prevented(run, dataset, _resampling(prevented), **engine)


def _resampling(part: Any) -> Resampling:
    """How intervals of a part of a summary were made; raises ResultsError."""
    try:
        return Resampling(**part["resampling"])
    except (LookupError, TypeError) as error:
        raise ResultsError(f"{SUMMARY_FILE}: does not say how intervals were made ({error})") from error


def _version(bundle: Bundle) -> Iterator[Difference]:
    stored = bundle.summary.get("devkit_version", ABSENT)
    if stored != __version__:
        yield Difference(kind="version", where="devkit_version", stored=stored, found=__version__)


def _files(bundle: Bundle) -> Iterator[Difference]:
    try:
        stored = bundle.checksums()
    except ResultsError as error:
        yield Difference(kind="file", where=FILES_FILE, stored="a list of all files", found=str(error))
        return
    for name, one, other in differing(stored, checksums_of(bundle.folder, stored)):
        yield Difference(kind="file", where=name, stored=one, found=other)


def _scenarios(bundle: Bundle, dataset: Dataset, engine: Mapping[str, Any]) -> Iterator[Difference]:
    try:
        stored = bundle.scenarios()
    except ResultsError as error:
        yield Difference(kind="file", where=SCENARIOS_FILE, stored="hashes", found=str(error))
        return
    found = {token: each.as_dict() for token, each in scenario_hashes(dataset, stored, **engine).items()}
    for token, hashes in stored.items():
        if token not in found:
            yield Difference(kind="scenario", where=token, stored="in the release", found=ABSENT)
            continue
        for kind, one, other in differing(hashes, found[token]):
            yield Difference(kind="scenario", where=f"{token}: {kind}", stored=one, found=other)


def _unlisted(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    """Scenarios that are evaluated, and whose hashes the bundle does not state."""
    try:
        stored = bundle.scenarios()
    except ResultsError:  # told already
        return
    for token in run.release.scenarios.keys() - stored.keys():
        yield Difference(kind="scenario", where=token, stored=ABSENT, found="evaluated")


def _results(bundle: Bundle, results: Results) -> Iterator[Difference]:
    stored = bundle.summary["results"].get("fingerprint", ABSENT)
    if stored != results.fingerprint:
        where = f"fingerprint of {results.path}"
        yield Difference(kind="results", where=where, stored=stored, found=results.fingerprint)


def _numbers(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    elsewhere = ("split",) if "split" in bundle.outside_paths() else ()
    for where, stored, found in differing(bundle.summary, run.summary(), without=(*_NOT_COMPARED, *elsewhere)):
        yield Difference(kind="number", where=where, stored=stored, found=found)


def _counts(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    path = bundle.folder / COUNTS_FILE
    try:
        stored = read_json(path, None)["counts"]
    except (ResultsError, KeyError) as error:
        yield Difference(kind="file", where=COUNTS_FILE, stored="counts", found=str(error))
        return
    for where, one, other in differing(stored, dict(run.evaluator.counts)):
        yield Difference(kind="sample", where=f"{COUNTS_FILE} {where}", stored=one, found=other)


def _rows(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    try:
        rows, _ = read_rows(own_file(bundle.folder / ROWS_FILE))
        stored = {row["token"]: row for row in rows}
    except (ResultsError, KeyError) as error:
        yield Difference(kind="file", where=ROWS_FILE, stored="rows", found=str(error))
        return
    found = {row["token"]: row for row in sample_rows(run)}
    for where, one, other in differing(stored, found):
        yield Difference(kind="sample", where=f"{ROWS_FILE} {where}", stored=one, found=other)


def _notes(bundle: Bundle, run: EvaluationRun | None, found: Sequence[Difference]) -> Iterator[str]:
    if any(each.kind == "scenario" for each in found):
        yield (
            "numbers are made of the index, which does not see that a file was edited in place; bring it up to date "
            "with: deepaccident index DATAROOT --check"
        )
    if bundle.summary.get("sanity") is not None:
        yield "the sanity check is not made again"
    if run is None:
        return
    here = run.summary()["environment"]
    for name, stored, now in differing(bundle.summary["environment"], here):
        yield f"evaluated with {name} {stored}, verified with {now}"
