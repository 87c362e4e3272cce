"""`verify_bundle`: an evaluation run again, and how what its bundle says differs (`differing`)."""

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
ABSENT: Final = "absent"
# Characters of a value that a line shows.
_LONGEST: Final = 60
_LONGEST_PLACE: Final = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference(ShortRepr):
    """What a bundle says, and what was found.

    Attributes:
        where: its file and its place there, such as `metrics_summary.json: metrics/apa`.
        stored: what the bundle says.
        found: what was found.
    """

    where: str
    stored: Any
    found: Any

    def text(self) -> str:
        """In a line."""
        where = shortened(
            self.where if self.where.isprintable() else ascii(self.where), _LONGEST_PLACE
        )
        return f"{where}: stored {_short(self.stored)}, found {_short(self.found)}"


def differing(
    stored: Any, found: Any, *, without: Collection[str] = (), path: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """The paths at which two values differ that JSON can hold, and what is there; numbers must be exactly equal.

    `without` are paths that do not count, with all below them; `path` is that of both values.
    """
    if path in without:
        return
    parts: Mapping[Any, tuple[Any, Any]] = {}
    stored, found = (
        value.as_dict() if isinstance(value, ScenarioHashes) else value for value in (stored, found)
    )
    if isinstance(stored, Mapping) and isinstance(found, Mapping):
        parts = {
            name: (stored.get(name, ABSENT), found.get(name, ABSENT))
            for name in {**stored, **found}
        }
    elif isinstance(stored, list) and isinstance(found, list) and len(stored) == len(found):
        parts = dict(enumerate(zip(stored, found, strict=True)))
    elif type(stored) is not type(found) or stored != found:
        yield path, stored, found
    for name, (one, other) in parts.items():
        yield from differing(
            one, other, without=without, path=f"{path}/{name}" if path else str(name)
        )


def _short(value: Any) -> str:
    text = value if value == ABSENT else repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


# Differences that the text lists.
_SHOWN: Final = 20
# Of a summary: what is told in notes, or says where things were.
_NOT_COMPARED: Final = ("environment", "sanity", "release/dataroot", "results/path")


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification(Report):
    """A bundle against its evaluation made again.

    Attributes:
        folder: of the bundle.
        samples: how many were evaluated again.
        differences: all that were found, file by file.
        notes: sentences on what is not compared, or explains differences.
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
        """A line a difference, the first ones, and how many more there are."""
        again = f"{counted(self.samples, 'sample')} evaluated again"
        found = f"{counted(len(self.differences), 'difference')}; {again}"
        same = f"the same; {again}, all numbers are equal"
        lines = [f"{self.folder}: {same if self.is_same else found}"]
        lines += [f"  {each.text()}" for each in self.differences[:_SHOWN]]
        lines += [f"  and {len(self.differences) - _SHOWN} more"] * (len(self.differences) > _SHOWN)
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def to_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        return {
            "folder": os.fspath(self.folder),
            "same": self.is_same,
            "samples": self.samples,
            "differences": [asdict(each) for each in self.differences],
            "notes": list(self.notes),
        }

    def named_tables(self) -> dict[str, list[Row]]:
        """A line a difference."""
        return {"differences": record_rows(Difference, self.differences)}


def verify_bundle(
    folder: str | os.PathLike[str],
    dataset: Dataset,
    *,
    results: Results | str | os.PathLike[str] | None = None,
    split: str | os.PathLike[str] | None = None,
    **how: Unpack[Engine],
) -> Verification:
    """Evaluate again what a bundle is of, and compare everything with it; numbers must be equal to the bit.

    A bundle may come from anyone. So no path in it that leads out of it is opened (`Bundle.outside_paths`), and no link
    in it is followed; files that do not belong to it are named, not opened.

    Args:
        folder: of the bundle.
        dataset: the release; where `read_bundle(folder).dataroot` says, or another copy of it.
        results: the predictions; None for the bundle's own copy.
        split: the split file, if the bundle is of one; else None.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        ResultsError: there is no bundle of this devkit's format, no results to evaluate, or a path must be given.
    """
    bundle = read_bundle(path_of(folder))
    check_repeated(bundle, {"dataroot": dataset.dataroot, "results": results, "split": split})
    given = bundle.results_path if results is None else results
    opened = given if isinstance(given, Results) else read_results(given)
    found = list(_compared(FILES_FILE, bundle.checksums, partial(checksums_of, bundle.folder)))
    notes, run = [], None
    try:
        run = _again(bundle, dataset, opened, split, how)
    except DeepAccidentError as error:
        found.append(Difference(where="all numbers", stored="evaluated", found=ABSENT))
        notes.append(f"cannot be evaluated again: {error}")
    else:
        found += _differences(bundle, run)
        notes += [
            f"evaluated with {name} {stored}, verified with {now}"
            for name, stored, now in differing(
                bundle.summary["environment"], run.summary()["environment"]
            )
        ]
    if bundle.summary.get("sanity") is not None:
        notes.append("the sanity check is not made again")
    return Verification(
        folder=bundle.folder,
        samples=0 if run is None else len(run.evaluator),
        differences=tuple(found),
        notes=tuple(notes),
    )


def check_repeated(bundle: Bundle, given: Mapping[str, object]) -> None:
    """Raise ResultsError unless all `Bundle.outside_paths` are given; it says how to give them as they are there."""
    outside = bundle.outside_paths()
    if any(given[name] is None for name in outside):
        options = " ".join(f"--{name} {shlex.quote(path)}" for name, path in outside.items())
        raise ResultsError(
            f"{bundle.folder}: names paths outside of it, which are opened only if you give them: deepaccident "
            f"check bundle {shlex.quote(os.fspath(bundle.folder))} {options}"
        )


def _again(
    bundle: Bundle,
    dataset: Dataset,
    results: Results,
    split: str | os.PathLike[str] | None,
    how: Engine,
) -> EvaluationRun:
    summary, selection = bundle.summary, bundle.selection
    if split is not None:
        selection = replace(selection, split=os.fspath(split))
    partly = summary["partial"] is not None or bool(summary["counts"]["left_out"])
    run = evaluate_results(dataset, results, bundle.setup, selection, allow_partial=partly, **how)
    breakdowns = summary["breakdowns"]
    how = {"workers": None, **how, "progress": False}
    if breakdowns:
        run = run.broken_down(list(breakdowns), _resampling(next(iter(breakdowns.values()))), **how)
    for name in further_names(summary):
        run = with_further(run, name, dataset, _resampling(summary[name]), **how)
    return run


def _resampling(part: Any) -> Resampling:
    """How intervals of a part of a summary were made; raises ResultsError."""
    try:
        return Resampling(**part["resampling"])
    except (LookupError, TypeError) as error:
        raise ResultsError(
            f"{SUMMARY_FILE}: does not say how intervals were made ({error})"
        ) from error


def _differences(bundle: Bundle, run: EvaluationRun) -> Iterator[Difference]:
    """Of all files but their list."""
    elsewhere = ("split",) if "split" in bundle.outside_paths() else ()
    truth, summary = dict(run.release.scenarios), run.summary()
    with suppress(ResultsError):  # is a difference of the file, below
        truth |= {
            token: hashes
            for token, hashes in bundle.scenarios().items()
            if hashes.is_like(truth.get(token))
        }
        summary["release"]["fingerprint"] = fingerprint(truth)
    for where, stored, found in differing(
        bundle.summary, summary, without=(*_NOT_COMPARED, *elsewhere)
    ):
        yield Difference(where=f"{SUMMARY_FILE}: {where}", stored=stored, found=found)
    rows = {
        row["token"]: row for row in rows_table(sample_rows(run)).to_pylist()
    }  # as a file would have them
    yield from _compared(SCENARIOS_FILE, bundle.scenarios, lambda _: truth)
    yield from _compared(COUNTS_FILE, bundle.counts, lambda _: dict(run.evaluator.counts))
    yield from _compared(ROWS_FILE, bundle.rows, lambda _: rows)


def _compared(
    name: str, read: Callable[[], Any], again: Callable[[Any], Any]
) -> Iterator[Difference]:
    """The differences of a bundle's file; one if it cannot be read."""
    try:
        stored = read()
    except ResultsError as error:
        reason = str(error).split(f"{name}: ", 1)[-1]  # without the folder, which would fill a line
        yield Difference(where=name, stored="readable", found=reason)
        return
    for where, one, other in differing(stored, again(stored)):
        yield Difference(where=f"{name}: {where}", stored=one, found=other)
