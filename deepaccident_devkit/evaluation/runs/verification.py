"""`verify_bundle` repeats the evaluation of a bundle, and lists all differences."""

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
from deepaccident_devkit.support.text import PathType, counted, path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine


# Text that replaces a missing value.
ABSENT_TEXT: Final = "absent"
# A line shows at most this many characters of a value.
_MAX_VALUE_LENGTH = 60
# A line shows at most this many characters of a path.
_MAX_PATH_LENGTH = 300
# The text lists at most this many differences.
_MAX_DIFFERENCES = 20
# Paths in a summary that are not compared, since notes report their differences, or since their
# values are only locations.
_NOT_COMPARED = ("environment", "sanity", "release/dataroot", "results/path")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference(ShortRepr):
    """A value in a bundle that differs from that in the repeated evaluation.

    Attributes:
        where: File, and path in the file, such as `metrics_summary.json: metrics/apa`.
        stored: Value in the bundle.
        found: Value in the repeated evaluation.
    """

    where: str
    stored: Any
    found: Any

    def text(self) -> str:
        """Format the difference in one line."""
        where = self.where
        if not where.isprintable():
            where = ascii(where)
        path = shortened(where, _MAX_PATH_LENGTH)
        stored = _value_excerpt(self.stored)
        found = _value_excerpt(self.found)
        return f"{path}: stored {stored}, found {found}"


def find_differences(
    stored: Any, actual: Any, *, without: Collection[str] = (), path: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield path, stored value and actual value wherever two JSON values differ.

    Numbers must be exactly equal.

    Args:
        stored: Value that was stored.
        actual: Value that the stored one is compared with.
        without: Paths that are skipped, with everything below them.
        path: Path at which both values are found.
    """
    if path in without:
        return
    stored = _as_json(stored)
    actual = _as_json(actual)
    parts: dict[Any, tuple[Any, Any]] = {}
    if isinstance(stored, Mapping) and isinstance(actual, Mapping):
        for name in {**stored, **actual}:
            parts[name] = (stored.get(name, ABSENT_TEXT), actual.get(name, ABSENT_TEXT))
    elif isinstance(stored, list) and isinstance(actual, list) and len(stored) == len(actual):
        parts = dict(enumerate(zip(stored, actual, strict=True)))
    elif type(stored) is not type(actual) or stored != actual:
        yield path, stored, actual
    for name, (stored_part, actual_part) in parts.items():
        part_path = f"{path}/{name}" if path else str(name)
        yield from find_differences(stored_part, actual_part, without=without, path=part_path)


def _as_json(value: Any) -> Any:
    """Convert the hashes of a scenario to JSON values, and leave other values as they are."""
    if isinstance(value, ScenarioHashes):
        return value.as_dict()
    return value


def _value_excerpt(value: Any) -> str:
    """Format a value, and truncate its text if it is long."""
    text = value if value == ABSENT_TEXT else repr(value)
    if len(text) <= _MAX_VALUE_LENGTH:
        return text
    return f"{text[: _MAX_VALUE_LENGTH - 1]}…"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification(Report):
    """Comparison of a bundle with a repetition of the same evaluation.

    Attributes:
        folder: Folder of the bundle.
        samples: Number of samples that were evaluated again.
        differences: All differences, file by file.
        notes: Sentences that explain differences, or say what is not compared.
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
        """Format a line for each of the first differences, and say how many more there are."""
        repeated = f"{counted(self.samples, 'sample')} evaluated again"
        if self.is_same:
            head = f"identical: {repeated}, all numbers are equal"
        else:
            head = f"{counted(len(self.differences), 'difference')}; {repeated}"
        lines = [f"{self.folder}: {head}"]
        lines += [f"  {difference.text()}" for difference in self.differences[:_MAX_DIFFERENCES]]
        hidden_count = len(self.differences) - _MAX_DIFFERENCES
        if hidden_count > 0:
            lines.append(f"  and {hidden_count} more")
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Convert all fields to JSON-compatible values."""
        return {
            "folder": os.fspath(self.folder),
            "same": self.is_same,
            "samples": self.samples,
            "differences": [asdict(difference) for difference in self.differences],
            "notes": list(self.notes),
        }

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a single table with one row per difference."""
        return {"differences": record_rows(Difference, self.differences)}


def verify_bundle(
    folder: PathType,
    dataset: Dataset,
    *,
    results: Results | str | os.PathLike[str] | None = None,
    split: PathType | None = None,
    **engine: Unpack[Engine],
) -> Verification:
    """Repeat the evaluation of a bundle and compare everything; numbers must be equal to the bit.

    A bundle may come from anyone. So paths that lead out of it (`Bundle.outside_paths`) are not
    opened, and links in it are not followed. Files that do not belong to it are reported, but not
    opened.

    Args:
        folder: Folder of the bundle.
        dataset: Release at `read_bundle(folder).dataroot`, or another copy of it.
        results: Predictions, or their path; None for the copy in the bundle.
        split: Path of the split file, if the bundle was evaluated on one; otherwise None.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        ResultsError: If the folder is not a bundle that this devkit can read, there are no results
            to evaluate, or a path that leads out of the bundle was not passed.
    """
    bundle = read_bundle(path_of(folder))
    check_repeated(bundle, {"dataroot": dataset.dataroot, "results": results, "split": split})
    if results is None:
        results = bundle.results_path
    if not isinstance(results, Results):
        results = read_results(results)
    read_checksums = partial(checksums_of, bundle.folder)
    differences = list(_compare_file(FILES_FILE, bundle.checksums, read_checksums))
    notes = []
    sample_count = 0
    try:
        run = _repeat_evaluation(bundle, dataset, results, split, engine)
    except DeepAccidentError as error:
        differences.append(Difference(where="all numbers", stored="evaluated", found=ABSENT_TEXT))
        notes.append(f"cannot be evaluated again: {error}")
    else:
        sample_count = len(run.evaluator)
        differences += _compare_files(bundle, run)
        environment = run.summary()["environment"]
        for name, stored, actual in find_differences(bundle.summary["environment"], environment):
            notes.append(f"evaluated with {name} {stored}, verified with {actual}")
    if bundle.summary.get("sanity") is not None:
        notes.append("the sanity check is not repeated")
    return Verification(
        folder=bundle.folder,
        samples=sample_count,
        differences=tuple(differences),
        notes=tuple(notes),
    )


def check_repeated(bundle: Bundle, arguments: Mapping[str, object]) -> None:
    """Raise ResultsError unless all paths in `Bundle.outside_paths` were passed.

    The message contains the complete command.

    Args:
        bundle: Bundle to repeat.
        arguments: Name of a path → the path that the caller passed, or None.
    """
    outside = bundle.outside_paths()
    if any(arguments[name] is None for name in outside):
        options = " ".join(f"--{name} {shlex.quote(path)}" for name, path in outside.items())
        raise ResultsError(
            f"{bundle.folder}: names paths outside its folder, which are opened only if you give "
            f"them: deepaccident check bundle {shlex.quote(os.fspath(bundle.folder))} {options}"
        )


def _repeat_evaluation(
    bundle: Bundle,
    dataset: Dataset,
    results: Results,
    split: PathType | None,
    engine: Engine,
) -> EvaluationRun:
    """Repeat the evaluation of a bundle, with its breakdowns and further results."""
    summary = bundle.summary
    selection = bundle.selection
    if split is not None:
        selection = replace(selection, split=os.fspath(split))
    is_partial = summary["partial"] is not None or bool(summary["counts"]["left_out"])
    run = evaluate_results(
        dataset, results, bundle.setup, selection, allow_partial=is_partial, **engine
    )
    breakdowns = summary["breakdowns"]
    engine = {"workers": None, **engine, "progress": False}
    if breakdowns:
        first_breakdown = next(iter(breakdowns.values()))
        resampling = _read_resampling(first_breakdown)
        run = run.broken_down(list(breakdowns), resampling, **engine)
    for name in further_names(summary):
        resampling = _read_resampling(summary[name])
        run = with_further(run, name, dataset, resampling, **engine)
    return run


def _read_resampling(part: Any) -> Resampling:
    """Read how the intervals in a part of a summary were made; raise ResultsError if unknown."""
    try:
        return Resampling(**part["resampling"])
    except (LookupError, TypeError) as error:
        raise ResultsError(
            f"{SUMMARY_FILE}: does not say how intervals were made ({error})"
        ) from error


def _compare_files(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    """Yield the differences in all files except for the list of files."""
    skipped = list(_NOT_COMPARED)
    if "split" in bundle.outside_paths():
        skipped.append("split")
    hashes_by_scenario = dict(run.release.scenarios)
    summary = run.summary()
    with suppress(ResultsError):  # reported below as a difference of the file
        for token, hashes in bundle.scenarios().items():
            if hashes.is_like(hashes_by_scenario.get(token)):
                hashes_by_scenario[token] = hashes
        summary["release"]["fingerprint"] = fingerprint(hashes_by_scenario)
    for path, stored, actual in find_differences(bundle.summary, summary, without=skipped):
        yield Difference(where=f"{SUMMARY_FILE}: {path}", stored=stored, found=actual)
    row_list = rows_table(sample_rows(run)).to_pylist()  # with the types of a written file
    rows = {row["token"]: row for row in row_list}
    yield from _compare_file(SCENARIOS_FILE, bundle.scenarios, lambda _: hashes_by_scenario)
    yield from _compare_file(COUNTS_FILE, bundle.counts, lambda _: dict(run.evaluator.counts))
    yield from _compare_file(ROWS_FILE, bundle.rows, lambda _: rows)


def _compare_file(
    name: str, read: Callable[[], Any], recompute: Callable[[Any], Any]
) -> Iterator[Difference]:
    """Yield the differences in a file of a bundle, or a single one if the file cannot be read.

    Args:
        name: Name of the file.
        read: Function that reads the stored content.
        recompute: Function that takes the stored content and returns the actual content.
    """
    try:
        stored = read()
    except ResultsError as error:
        reason = str(error).split(f"{name}: ", 1)[-1]  # without the folder, which would fill a line
        yield Difference(where=name, stored="readable", found=reason)
        return
    for path, stored_value, actual_value in find_differences(stored, recompute(stored)):
        yield Difference(where=f"{name}: {path}", stored=stored_value, found=actual_value)
