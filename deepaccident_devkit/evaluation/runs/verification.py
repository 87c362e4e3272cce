"""`verify_bundle` repeats an evaluation, and `find_differences` lists how its bundle differs."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import DeepAccidentError, ResultsError, shortened
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs.bundles import (
    COUNTS_FILE,
    FILES_FILE,
    ROWS_FILE,
    SCENARIOS_FILE,
    SUMMARY_FILE,
    Bundle,
    checksums_of,
    read_bundle,
)
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun, evaluate_results
from deepaccident_devkit.evaluation.runs.further import further_names, with_further
from deepaccident_devkit.evaluation.runs.rows import rows_table, sample_rows
from deepaccident_devkit.release.fingerprints import ScenarioHashes, fingerprint
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import counted, path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine


# Stands for a missing value.
ABSENT_TEXT: Final = "absent"
# Number of characters of a value, and of its path, that a line shows.
_MAX_VALUE_LENGTH: Final = 60
_MAX_PATH_LENGTH: Final = 300
# Number of differences that the text lists.
_MAX_DIFFERENCES: Final = 20
# Paths in a summary that notes report, or that only name locations.
_NOT_COMPARED: Final = ("environment", "sanity", "release/dataroot", "results/path")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference(ShortRepr):
    """A value in a bundle that differs from the value found.

    Attributes:
        where: File and path in it, such as `metrics_summary.json: metrics/apa`.
        stored: Value in the bundle.
        found: Value of the repeated evaluation.
    """

    where: str
    stored: Any
    found: Any

    def text(self) -> str:
        """Return the difference in one line."""
        where = self.where if self.where.isprintable() else ascii(self.where)
        path = shortened(where, _MAX_PATH_LENGTH)
        return f"{path}: stored {_short(self.stored)}, found {_short(self.found)}"


def find_differences(
    stored: Any, actual: Any, *, without: Collection[str] = (), path: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield path, stored value and actual value wherever two values of JSON differ.

    Numbers must be exactly equal.

    Args:
        stored: Value that was stored.
        actual: Value to compare with it.
        without: Paths that are skipped, with everything below them.
        path: Path of both values.
    """
    if path in without:
        return
    stored, actual = _as_json(stored), _as_json(actual)
    parts: Mapping[Any, tuple[Any, Any]] = {}
    if isinstance(stored, Mapping) and isinstance(actual, Mapping):
        parts = {
            name: (stored.get(name, ABSENT_TEXT), actual.get(name, ABSENT_TEXT))
            for name in {**stored, **actual}
        }
    elif isinstance(stored, list) and isinstance(actual, list) and len(stored) == len(actual):
        parts = dict(enumerate(zip(stored, actual, strict=True)))
    elif type(stored) is not type(actual) or stored != actual:
        yield path, stored, actual
    for name, (stored_part, actual_part) in parts.items():
        part_path = f"{path}/{name}" if path else str(name)
        yield from find_differences(stored_part, actual_part, without=without, path=part_path)


def _as_json(value: Any) -> Any:
    if isinstance(value, ScenarioHashes):
        return value.as_dict()
    return value


def _short(value: Any) -> str:
    text = value if value == ABSENT_TEXT else repr(value)
    if len(text) <= _MAX_VALUE_LENGTH:
        return text
    return f"{text[: _MAX_VALUE_LENGTH - 1]}…"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification(Report):
    """A bundle compared with its evaluation repeated.

    Attributes:
        folder: Folder of the bundle.
        samples: Number of samples that were evaluated again.
        differences: All differences, file by file.
        notes: Sentences on what is not compared, or that explain differences.
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
        """Return a line for each of the first differences, and how many more there are."""
        again = f"{counted(self.samples, 'sample')} evaluated again"
        if self.is_same:
            head = f"the same; {again}, all numbers are equal"
        else:
            head = f"{counted(len(self.differences), 'difference')}; {again}"
        lines = [f"{self.folder}: {head}"]
        lines += [f"  {difference.text()}" for difference in self.differences[:_MAX_DIFFERENCES]]
        hidden = len(self.differences) - _MAX_DIFFERENCES
        if hidden > 0:
            lines.append(f"  and {hidden} more")
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return all values in JSON form."""
        return {
            "folder": os.fspath(self.folder),
            "same": self.is_same,
            "samples": self.samples,
            "differences": [asdict(difference) for difference in self.differences],
            "notes": list(self.notes),
        }

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a table with a row for each difference."""
        return {"differences": record_rows(Difference, self.differences)}


def verify_bundle(
    folder: str | os.PathLike[str],
    dataset: Dataset,
    *,
    results: Results | str | os.PathLike[str] | None = None,
    split: str | os.PathLike[str] | None = None,
    **engine: Unpack[Engine],
) -> Verification:
    """Repeat the evaluation of a bundle and compare everything; numbers must be equal to the bit.

    A bundle may come from anyone. So paths that lead out of it (`Bundle.outside_paths`) are not
    opened, and links in it are not followed. Files that do not belong to it are named, not opened.

    Args:
        folder: Folder of the bundle.
        dataset: The release at `read_bundle(folder).dataroot`, or another copy of it.
        results: The predictions; None for the bundle's own copy.
        split: The split file, if the bundle was evaluated on one; otherwise None.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        ResultsError: there is no bundle of this devkit's format, no results to evaluate, or a path
            must be given.
    """
    bundle = read_bundle(path_of(folder))
    check_repeated(bundle, {"dataroot": dataset.dataroot, "results": results, "split": split})
    source = bundle.results_path if results is None else results
    opened = source if isinstance(source, Results) else read_results(source)
    differences = list(
        _compare_file(FILES_FILE, bundle.checksums, partial(checksums_of, bundle.folder))
    )
    notes, run = [], None
    try:
        run = _repeat(bundle, dataset, opened, split, engine)
    except DeepAccidentError as error:
        differences.append(Difference(where="all numbers", stored="evaluated", found=ABSENT_TEXT))
        notes.append(f"cannot be evaluated again: {error}")
    else:
        differences += _differences(bundle, run)
        environments = bundle.summary["environment"], run.summary()["environment"]
        for name, stored, actual in find_differences(*environments):
            notes.append(f"evaluated with {name} {stored}, verified with {actual}")
    if bundle.summary.get("sanity") is not None:
        notes.append("the sanity check is not made again")
    return Verification(
        folder=bundle.folder,
        samples=0 if run is None else len(run.evaluator),
        differences=tuple(differences),
        notes=tuple(notes),
    )


def check_repeated(bundle: Bundle, arguments: Mapping[str, object]) -> None:
    """Raise ResultsError unless all `Bundle.outside_paths` are given; the message has the command.

    Args:
        bundle: The bundle.
        arguments: Name of a path → the argument for it, or None.
    """
    outside = bundle.outside_paths()
    if any(arguments[name] is None for name in outside):
        options = " ".join(f"--{name} {shlex.quote(path)}" for name, path in outside.items())
        raise ResultsError(
            f"{bundle.folder}: names paths outside of it, which are opened only if you give them: "
            f"deepaccident check bundle {shlex.quote(os.fspath(bundle.folder))} {options}"
        )


def _repeat(
    bundle: Bundle,
    dataset: Dataset,
    results: Results,
    split: str | os.PathLike[str] | None,
    engine: Engine,
) -> EvaluationRun:
    """Return the bundle's evaluation, made again with its breakdowns and further results."""
    summary, selection = bundle.summary, bundle.selection
    if split is not None:
        selection = replace(selection, split=os.fspath(split))
    is_partial = summary["partial"] is not None or bool(summary["counts"]["left_out"])
    run = evaluate_results(
        dataset, results, bundle.setup, selection, allow_partial=is_partial, **engine
    )
    breakdowns = summary["breakdowns"]
    engine = {"workers": None, **engine, "progress": False}
    if breakdowns:
        resampling = _resampling(next(iter(breakdowns.values())))
        run = run.broken_down(list(breakdowns), resampling, **engine)
    for name in further_names(summary):
        run = with_further(run, name, dataset, _resampling(summary[name]), **engine)
    return run


def _resampling(part: Any) -> Resampling:
    """Return how the intervals of a part of a summary were made; raises ResultsError."""
    try:
        return Resampling(**part["resampling"])
    except (LookupError, TypeError) as error:
        raise ResultsError(
            f"{SUMMARY_FILE}: does not say how intervals were made ({error})"
        ) from error


def _differences(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    """Yield the differences of all files except their list."""
    skipped = ("split",) if "split" in bundle.outside_paths() else ()
    truth, summary = dict(run.release.scenarios), run.summary()
    with suppress(ResultsError):  # is reported as a difference of the file, below
        for token, hashes in bundle.scenarios().items():
            if hashes.is_like(truth.get(token)):
                truth[token] = hashes
        summary["release"]["fingerprint"] = fingerprint(truth)
    compared = find_differences(bundle.summary, summary, without=(*_NOT_COMPARED, *skipped))
    for path, stored, actual in compared:
        yield Difference(where=f"{SUMMARY_FILE}: {path}", stored=stored, found=actual)
    row_list = rows_table(sample_rows(run)).to_pylist()  # with the types that a file would have
    rows = {row["token"]: row for row in row_list}
    yield from _compare_file(SCENARIOS_FILE, bundle.scenarios, lambda _: truth)
    yield from _compare_file(COUNTS_FILE, bundle.counts, lambda _: dict(run.evaluator.counts))
    yield from _compare_file(ROWS_FILE, bundle.rows, lambda _: rows)


def _compare_file(
    name: str, read: Callable[[], Any], recompute: Callable[[Any], Any]
) -> Iterator[Difference]:
    """Yield the differences of a bundle's file; a single one if it cannot be read.

    Args:
        name: Name of the file.
        read: Reads the stored content.
        recompute: Returns the actual content for the stored one.
    """
    try:
        stored = read()
    except ResultsError as error:
        reason = str(error).split(f"{name}: ", 1)[-1]  # without the folder, which would fill a line
        yield Difference(where=name, stored="readable", found=reason)
        return
    for path, stored_value, actual_value in find_differences(stored, recompute(stored)):
        yield Difference(where=f"{name}: {path}", stored=stored_value, found=actual_value)
