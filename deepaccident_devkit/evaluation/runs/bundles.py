"""Bundles: an evaluation's folder, from which others can check and compare its numbers: written, read and checked."""

from __future__ import annotations

import json
import math
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from deepaccident_devkit.errors import MOST_TOLD, EvaluationError, ResultsError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.results.records import check_token
from deepaccident_devkit.evaluation.runs.evaluation_run import (
    SUMMARY_FORMAT,
    SUMMARY_VERSION,
    EvaluationRun,
)
from deepaccident_devkit.evaluation.runs.rows import Row, read_rows, sample_rows, write_rows
from deepaccident_devkit.evaluation.runs.setups import (
    EvaluationSetup,
    SampleSelection,
    is_task,
    remove_checkpoints,
    scenario_of,
)
from deepaccident_devkit.evaluation.warning.recordings import GROUPS
from deepaccident_devkit.release.fingerprints import ScenarioHashes
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import remove_in, replacing_folder, temporary_path
from deepaccident_devkit.support.json_text import Record, as_record, parsed_json
from deepaccident_devkit.support.reading import (
    check_size,
    fault_text,
    file_checksum,
    irregular_text,
    read_bytes,
)
from deepaccident_devkit.support.text import differing_text, path_of
from deepaccident_devkit.taxonomy import SPLIT_CHOICES

SUMMARY_FILE: Final = "metrics_summary.json"
COUNTS_FILE: Final = "counts.json"
ROWS_FILE: Final = "samples.parquet"
SCENARIOS_FILE: Final = "scenarios.json"
FILES_FILE: Final = "files.json"
RESULTS_FOLDER: Final = "results"
SCENARIOS_FORMAT: Final = "DeepAccident scenario hashes"
FILES_FORMAT: Final = "DeepAccident evaluation bundle"
# A name, a path, a checksum: what shows in a terminal, in a line.
Line = Annotated[
    str,
    msgspec.Meta(
        max_length=1000,
        pattern=r"^[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]*\Z",
    ),
]
# Which threshold of an evaluation is taken: of the best F1; of at most one second a minute in false alarm; or of at
# most one second a minute of braking for false alarms, which the evaluation of prevented accidents finds.
Chooser = Literal["best_f1", "quiet", "braking"]
_UNCLEAR: Final = "does not say what was evaluated: "
_REMEDY: Final = "give a folder that `deepaccident evaluate … --out` wrote, or evaluate again"


class _Release(msgspec.Struct):
    version: Line
    dataroot: Line


class _Results(msgspec.Struct):
    path: Line
    form: dict[str, Any] | None


class _Counts(msgspec.Struct):
    left_out: int


class _Partial(msgspec.Struct):
    mark: Line


class _Breakdown(msgspec.Struct):
    resampling: dict[str, Any]


class _Summary(msgspec.Struct):
    """Of `metrics_summary.json` all that is used, and not only compared."""

    task: Line
    protocol: Line
    switches: dict[str, Any]
    horizon: float
    split: Line
    samples: Line
    scope: Line
    agents: list[Line] | None
    counts: _Counts
    partial: _Partial | None
    release: _Release
    results: _Results
    breakdowns: dict[str, _Breakdown]
    environment: dict[str, Line]


class _Scenarios(msgspec.Struct):
    """Of `scenarios.json`: scenario → hashes of its label, meta and calib files."""

    scenarios: dict[Line, ScenarioHashes]


class _Files(msgspec.Struct):
    """Of `files.json`: file → checksum."""

    files: dict[Line, Line]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle(ShortRepr):
    """What `deepaccident evaluate … --out DIR` wrote, by its summary; the other files are read when needed.

    Attributes:
        folder: where.
        summary: of `metrics_summary.json`.
        selection: which samples.
    """

    folder: Path
    summary: Mapping[str, Any]
    selection: SampleSelection

    @property
    def setup(self) -> EvaluationSetup:
        """Return the task and its rules; raises ResultsError if the plug-in that has the task is not installed."""
        return _stated_setup(self.folder / SUMMARY_FILE, self.summary)

    @property
    def dataroot(self) -> str:
        """The release that it was evaluated with."""
        return str(self.summary["release"]["dataroot"])

    @property
    def release_version(self) -> str:
        """`v1` or `v1-mini`."""
        return str(self.summary["release"]["version"])

    @property
    def results_path(self) -> Path:
        """The results: the copy in the bundle where there is one, else where they were.

        Raises:
            ResultsError: a copy is not what it should be.
        """
        return self.results_copy() or Path(self.summary["results"]["path"])

    def outside_paths(self) -> dict[str, str]:
        """The paths in the summary that lead out of the bundle, and that `verify_bundle` opens only if it is told to.

        Returns:
            `dataroot`; `results`, where the bundle has no copy of them; `split`, where it is a split file.

        Raises:
            ResultsError: a copy of the results is not what it should be.
        """
        named = {"dataroot": self.dataroot}
        if self.results_copy() is None:
            named["results"] = self.summary["results"]["path"]
        if self.summary["split"] not in SPLIT_CHOICES:
            named["split"] = self.summary["split"]
        return named

    def scenarios(self) -> dict[str, ScenarioHashes]:
        """Return the hashes of each scenario's label, meta and calib files by token; raises ResultsError."""
        return _stated(self.folder / SCENARIOS_FILE, SCENARIOS_FORMAT, _Scenarios).scenarios

    def checksums(self) -> dict[str, str]:
        """File → checksum of all that was written, except the list itself; raises ResultsError."""
        return _stated(self.folder / FILES_FILE, FILES_FORMAT, _Files).files

    def counts(self) -> dict[str, Any]:
        """Token → the counts of a sample, as they are stored; raises ResultsError."""
        counts = read_json(self.folder / COUNTS_FILE, None).get("counts")
        if not isinstance(counts, dict):
            raise ResultsError(f"{self.folder / COUNTS_FILE}: holds no counts; {_REMEDY}")
        return counts

    def rows(self) -> dict[str, Row]:
        """Token → the row of a sample; raises ResultsError."""
        path = own_file(self.folder / ROWS_FILE)
        rows, _ = read_rows(path)
        if any(not isinstance(row.get("token"), str) for row in rows):
            raise ResultsError(f"{path}: has rows without a sample's token; {_REMEDY}")
        return {row["token"]: row for row in rows}

    def evaluator(self) -> Evaluator[Any]:
        """All counts, of which a result can be computed; raises ResultsError or EvaluationError."""
        path = own_file(self.folder / COUNTS_FILE)
        evaluator = self.setup.evaluator().resume(path)
        try:
            for token in evaluator.tokens:
                check_token(token)
            evaluator.compute()
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            told = f"{type(error).__name__}: {shortened(str(error))}"
            raise ResultsError(
                f"{path}: does not hold counts of its protocol ({told}); evaluate again"
            ) from error
        return evaluator

    def results_copy(self) -> Path | None:
        """The copy of the results in the bundle; None without one.

        Raises:
            ResultsError: it is not what it should be, or has links or pipes in it.
        """
        copies = self.folder / RESULTS_FOLDER
        if not os.path.lexists(copies):
            return None
        for name, irregular in entries_in(self.folder).items():
            if irregular and name.split("/")[0] == RESULTS_FOLDER:
                raise ResultsError(f"{self.folder}: {shortened(name)} is {irregular}; {_REMEDY}")
        inside = sorted(copies.iterdir()) if copies.is_dir() else []
        if len(inside) != 1:
            raise ResultsError(
                f"{copies}: expected one results file or folder, found {len(inside)}; {_REMEDY}"
            )
        return inside[0]


def read_bundle(folder: Path) -> Bundle:
    """Open a bundle; raises ResultsError if there is none that this devkit can read.

    A bundle whose task is one of a plug-in that is not installed opens, too: `summary["task"]` names it.
    """
    folder = path_of(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder}: no such folder; {_REMEDY}")
    path = folder / SUMMARY_FILE
    summary = read_json(path, SUMMARY_FORMAT)
    _record(path, summary, _Summary, _UNCLEAR)
    if is_task(summary["task"]):
        _stated_setup(path, summary)
    with _stating(path):
        selection = SampleSelection(
            agents=None if summary["agents"] is None else tuple(summary["agents"]),
            **{name: summary[name] for name in ("split", "samples", "scope", "horizon")},
        )
    return Bundle(folder=folder, summary=summary, selection=selection)


def _stated_setup(path: Path, summary: Mapping[str, Any]) -> EvaluationSetup:
    """Return the setup that a summary states; raises ResultsError."""
    with _stating(path):
        return EvaluationSetup(
            **{name: summary[name] for name in ("task", "protocol", "switches", "horizon")}
        )


@contextmanager
def _stating(path: Path) -> Iterator[None]:
    """Turn errors of impossible values into a ResultsError that names the summary."""
    try:
        yield
    except (
        ArithmeticError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:  # whatever a switch's value can cause
        raise ResultsError(
            f"{path}: {_UNCLEAR}{shortened(str(error), MOST_TOLD)}; {_REMEDY}"
        ) from error


def chosen_threshold(folder: Path, by: Chooser, tokens: Iterable[str]) -> float:
    """The threshold for some samples that an evaluation of warnings of another split found best for who is involved.

    A car does not know whether it will be involved, so that there is one threshold for all groups.

    Raises:
        ResultsError: there is no bundle.
        EvaluationError: it is of another task or protocol, has a scenario of these samples or its twin, or found no
            threshold.
    """
    bundle = read_bundle(folder)
    kind = bundle.setup.task, bundle.setup.protocol
    if kind != ("warning", "clean"):
        raise EvaluationError(
            f"{folder}: is an evaluation of {' '.join(kind)}; expected one of warning, protocol clean"
        )
    own = {cluster_of(scenario) for scenario in bundle.scenarios()}
    shared = sorted(
        {scenario for scenario in map(scenario_of, tokens) if cluster_of(scenario) in own}
    )
    if shared:
        raise EvaluationError(
            f"{folder}: is an evaluation of {shared[0]} or its twin, too; a threshold that is chosen on the recordings "
            "it is tried on flatters: give one of another split, such as train or val"
        )
    try:
        groups: Mapping[str, Any] = bundle.summary["prevented" if by == "braking" else "metrics"][
            "groups"
        ]
        group = next((name for name in GROUPS if name in groups), None)
        threshold = (
            None if group is None else groups[group]["quiet_braking" if by == "braking" else by]
        )
    except (LookupError, TypeError) as error:
        what, how = (
            ("prevented accidents", " with --prevented")
            if by == "braking"
            else ("metrics of warnings", "")
        )
        raise ResultsError(f"{folder}: its summary has no {what}; evaluate again{how}") from error
    if not isinstance(threshold, float) or not math.isfinite(threshold):
        raise EvaluationError(
            f"{folder}: found no threshold by {by}; choose another, or give one with --switch threshold=…"
        )
    return threshold


def _stated(path: Path, form: str, kind: type[Record]) -> Record:
    """What one of a bundle's JSON files states; raises ResultsError."""
    return _record(path, read_json(path, form), kind)


def _record(path: Path, content: object, kind: type[Record], told: str = "") -> Record:
    try:
        return as_record(content, kind)
    except ValueError as error:
        raise ResultsError(f"{path}: {told}{error}; {_REMEDY}") from error


def own_file(path: Path) -> Path:
    """The path of a bundle's file, which must not be a link; raises ResultsError."""
    if path.is_symlink():
        raise ResultsError(f"{path}: is a link, which is not followed; {_REMEDY}")
    return path


def read_json(path: Path, expected: str | None) -> dict[str, Any]:
    """One of a bundle's JSON files, of a format; None for the counts. Raises ResultsError."""
    try:
        content = parsed_json(
            read_bytes(own_file(path), "bundle" if expected else "results"), constants=not expected
        )
    except FileNotFoundError as error:
        raise ResultsError(f"{path}: is missing; {_REMEDY}") from error
    except (OSError, ValueError) as error:
        if isinstance(error, ResultsError):
            raise
        raise ResultsError(f"{path}: {fault_text(error)}; {_REMEDY}") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{path}: expected an object, found {type(content).__name__}; {_REMEDY}")
    found = content.get("format")
    if expected is None:
        return content
    if found != expected:
        raise ResultsError(
            f"{path}: expected the format {expected!r}, found {shortened(repr(found))}; {_REMEDY}"
        )
    if content.get("version") != SUMMARY_VERSION:
        version, writer = (
            shortened(repr(content.get(name))) for name in ("version", "devkit_version")
        )
        raise ResultsError(
            f"{path}: is of version {version}, this devkit reads {SUMMARY_VERSION}; use the devkit that wrote it "
            f"({writer})"
        )
    return content


def entries_in(folder: Path) -> dict[str, str | None]:
    """What is in a folder and in those below it, by its path there, in order → what it is (`a link`) if it is no file.

    Links are not followed.
    """
    found = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            mode = path.lstat().st_mode
            if not stat.S_ISDIR(mode):
                irregular = "a link" if stat.S_ISLNK(mode) else irregular_text(mode)
                found[path.relative_to(folder).as_posix()] = irregular
    return dict(sorted(found.items()))


def checksums_of(folder: Path, listed: Collection[str] | None = None) -> dict[str, str]:
    """File, as of `entries_in` → checksum, of all but the list of files itself.

    Listed files are opened, or all if None; a word stands for the checksum of others, links, pipes, and what cannot be
    read.
    """
    found = {}
    for name, irregular in entries_in(folder).items():
        if name == FILES_FILE:
            continue
        if listed is None:
            found[name] = file_checksum(folder / name)
        else:
            found[name] = irregular or (
                _checksum(folder / name) if name in listed else "a file that is not listed"
            )
    return found


def _checksum(path: Path) -> str:
    try:
        check_size(path.stat().st_size, "results")  # the largest that it can hold
        return file_checksum(path)
    except OSError as error:
        return fault_text(error)


def save_run(
    run: EvaluationRun,
    folder: str | os.PathLike[str],
    *,
    include_results: bool = False,
    overwrite: bool = False,
    extras: Sequence[Callable[[Path], object]] = (),
) -> Path:
    """Write a bundle: the folder then has all of it, or stays as it was; returns its path.

    It holds `metrics_summary.json` (`EvaluationRun.summary`), `counts.json` (the evaluator's, by sample),
    `samples.parquet` (`sample_rows`), `scenarios.json` (hashes of the truth), `files.json` (checksums of all these) and
    what the extras add. Each says the devkit's version, the protocol, and whether it is partial.

    Args:
        run: the evaluation.
        folder: where; new, empty, or with `overwrite` an earlier bundle.
        include_results: whether to copy the results into its folder `results`, so that it can be checked by itself.
        overwrite: whether an earlier bundle there is replaced. Another folder never is.
        extras: called one after another with the folder that is being written, to add a report or pictures.

    Raises:
        ResultsError: something else lies there, it cannot be written, or the results to copy are gone.
    """
    target = checked_target(folder, overwrite=overwrite)
    before: Path | None = None
    try:
        with replacing_folder(target) as temporary:
            _write(run, temporary, include_results=include_results)
            for extra in extras:
                extra(temporary)
            _write_json(
                temporary / FILES_FILE, FILES_FORMAT, run, {"files": checksums_of(temporary)}
            )
            before = _moved_aside(target)
    except OSError as error:
        raise ResultsError(
            f"{target}: cannot be written ({error}); make room there, or choose another"
        ) from error
    finally:
        if before is not None and not target.exists():
            before.rename(target)
        elif before is not None:
            remove_in(before.parent, before.name)
    remove_checkpoints(target)
    return target


def checked_target(
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    asked: Mapping[str, Any] | None = None,
) -> Path:
    """The path of a folder that a bundle can be written to; changes nothing.

    `asked` are values of the new summary: a message says which of them differ from those of the bundle that is there.

    Raises:
        ResultsError: something lies there that is no bundle, or one that is not to be replaced, or one with files that
            are not its own.
    """
    target = path_of(folder, "out: expected a folder", error=ResultsError).absolute()
    if not target.exists():
        return target
    if not target.is_dir():
        raise ResultsError(f"{target}: is a file; choose a folder that is new")
    found = entries_in(target)
    if not found:
        return target
    try:
        bundle = read_bundle(target)
        own = {*bundle.checksums(), FILES_FILE}
    except ResultsError as error:
        raise ResultsError(
            f"{target}: is not empty and holds no evaluation ({error}); choose a new folder"
        ) from error
    foreign = [name for name in found if name not in own]
    if foreign:
        raise ResultsError(
            f"{target}: holds {foreign[0]}, which is not of its evaluation; move it, or choose another"
        )
    if not overwrite:
        there = {**bundle.summary, "results": bundle.summary["results"]["path"]}
        text = differing_text({name: there[name] for name in asked or {}}, asked or {})
        raise ResultsError(
            f"{target}: holds an evaluation{f' ({text})' if text else ''}; pass overwrite=True (--overwrite) to "
            "replace it, or choose another folder"
        )
    return target


def _moved_aside(target: Path) -> Path | None:
    """Where an earlier bundle now lies, beside its place; None if there is none."""
    if not target.is_dir() or not any(target.iterdir()):
        return None
    return target.rename(temporary_path(target))


def _write(run: EvaluationRun, folder: Path, *, include_results: bool) -> None:
    (folder / SUMMARY_FILE).write_text(
        json.dumps(run.summary(), indent=1, ensure_ascii=False), encoding="utf-8"
    )
    run.evaluator.save(folder / COUNTS_FILE)
    counts = json.loads((folder / COUNTS_FILE).read_text(encoding="utf-8"))
    (folder / COUNTS_FILE).write_text(json.dumps(run.stamp | counts), encoding="utf-8")
    write_rows(folder / ROWS_FILE, sample_rows(run), run.stamp)
    _write_json(
        folder / SCENARIOS_FILE, SCENARIOS_FORMAT, run, {"scenarios": dict(run.release.scenarios)}
    )
    if include_results:
        _copy(Path(run.results.path), folder / RESULTS_FOLDER)


def _write_json(path: Path, name: str, run: EvaluationRun, content: Mapping[str, Any]) -> None:
    stated = {"format": name, "version": SUMMARY_VERSION, **run.stamp, **content}
    path.write_text(json.dumps(stated, indent=1, default=asdict), encoding="utf-8")


def _copy(source: Path, folder: Path) -> None:
    folder.mkdir()
    if source.is_dir():
        shutil.copytree(source, folder / source.name)
    else:
        shutil.copy2(source, folder / source.name)
