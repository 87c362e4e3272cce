"""Bundles: folders of evaluations, which others can check and compare."""

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

from deepaccident_devkit.errors import MAX_REASON_LENGTH, EvaluationError, ResultsError, shortened
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
from deepaccident_devkit.support.text import PathType, differing_text, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import SPLIT_CHOICES

SUMMARY_FILE: Final = "metrics_summary.json"
COUNTS_FILE: Final = "counts.json"
ROWS_FILE: Final = "samples.parquet"
SCENARIOS_FILE: Final = "scenarios.json"
FILES_FILE: Final = "files.json"
RESULTS_FOLDER: Final = "results"
SCENARIOS_FORMAT: Final = "DeepAccident scenario hashes"
FILES_FORMAT: Final = "DeepAccident evaluation bundle"
# A name, path or checksum that a terminal can show in a single line.
Line = Annotated[
    str,
    msgspec.Meta(
        max_length=1000,
        pattern=r"^[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]*\Z",
    ),
]
# Rule that chooses a threshold: the best F1 score; at most one second of false alarm per minute; or
# at most one second of braking per minute because of false alarms, from the evaluation of prevented
# accidents.
Chooser = Literal["best_f1", "quiet", "braking"]
_UNCLEAR = "does not say what was evaluated: "
_REMEDY = "give a folder that `deepaccident evaluate … --out` wrote, or evaluate again"


class _Release(msgspec.Struct):
    """Part of a summary that describes the release."""

    version: Line
    dataroot: Line


class _Results(msgspec.Struct):
    """Part of a summary that describes the results."""

    path: Line
    form: NamedValues | None


class _Counts(msgspec.Struct):
    """Part of a summary that contains the numbers of samples."""

    left_out: int


class _Partial(msgspec.Struct):
    """Part of a summary that contains the numbers of missing samples."""

    mark: Line


class _Breakdown(msgspec.Struct):
    """Part of a summary that contains a breakdown."""

    resampling: NamedValues


class _Summary(msgspec.Struct):
    """The parts of `metrics_summary.json` that are used, rather than only compared."""

    task: Line
    protocol: Line
    switches: NamedValues
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
    """Content of `scenarios.json`: scenario → hashes of its label, meta and calib files."""

    scenarios: dict[Line, ScenarioHashes]


class _Files(msgspec.Struct):
    """Content of `files.json`: file → checksum."""

    files: dict[Line, Line]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle(ShortRepr):
    """A bundle that `deepaccident evaluate … --out DIR` wrote; most files are read on demand.

    Attributes:
        folder: Folder of the bundle.
        summary: Content of `metrics_summary.json`.
        selection: Selection of the evaluated samples.
    """

    folder: Path
    summary: Mapping[str, Any]
    selection: SampleSelection

    @property
    def setup(self) -> EvaluationSetup:
        """Task and rules; raises ResultsError if the plug-in with the task is not installed."""
        path = self.folder / SUMMARY_FILE
        return _read_setup(path, self.summary)

    @property
    def dataroot(self) -> str:
        """Path of the release on which the predictions were evaluated."""
        release = self.summary["release"]
        return str(release["dataroot"])

    @property
    def release_version(self) -> str:
        """`v1` or `v1-mini`."""
        release = self.summary["release"]
        return str(release["version"])

    @property
    def results_path(self) -> Path:
        """Path of the results: the copy in the bundle if there is one, otherwise the original.

        Raises:
            ResultsError: If the copy is invalid.
        """
        copied_results = self.results_copy()
        if copied_results is not None:
            return copied_results
        return Path(self.summary["results"]["path"])

    def outside_paths(self) -> dict[str, str]:
        """Return the paths in the summary that lead out of the bundle, by name.

        `verify_bundle` opens them only if they are passed as arguments.

        Returns:
            `dataroot`; `results`, if the bundle has no copy of them; `split`, if the split is a
            split file.

        Raises:
            ResultsError: If the copy of the results is invalid.
        """
        paths = {"dataroot": self.dataroot}
        if self.results_copy() is None:
            paths["results"] = self.summary["results"]["path"]
        if self.summary["split"] not in SPLIT_CHOICES:
            paths["split"] = self.summary["split"]
        return paths

    def scenarios(self) -> dict[str, ScenarioHashes]:
        """Read the hashes of each scenario's label, meta and calib files.

        Raises:
            ResultsError: If the file is missing or invalid.
        """
        path = self.folder / SCENARIOS_FILE
        content = read_json(path, SCENARIOS_FORMAT)
        return _as_record(path, content, _Scenarios).scenarios

    def checksums(self) -> dict[str, str]:
        """Read the listed checksum of each file, except for the list itself.

        Raises:
            ResultsError: If the list is missing or invalid.
        """
        path = self.folder / FILES_FILE
        content = read_json(path, FILES_FORMAT)
        return _as_record(path, content, _Files).files

    def counts(self) -> dict[str, Any]:
        """Read the stored counts of each sample by token.

        Raises:
            ResultsError: If the file is missing or invalid.
        """
        path = self.folder / COUNTS_FILE
        counts = read_json(path, None).get("counts")
        if not isinstance(counts, dict):
            raise ResultsError(f"{path}: contains no counts; {_REMEDY}")
        return counts

    def rows(self) -> dict[str, Row]:
        """Read the row of each sample by token.

        Raises:
            ResultsError: If the file is missing or invalid.
        """
        path = own_file(self.folder / ROWS_FILE)
        rows, _ = read_rows(path)
        for row in rows:
            if not isinstance(row.get("token"), str):
                raise ResultsError(f"{path}: has rows without a sample token; {_REMEDY}")
        return {row["token"]: row for row in rows}

    def evaluator(self) -> Evaluator[Any]:
        """Build an evaluator from the stored counts.

        Raises:
            ResultsError: If the counts are missing or invalid.
            EvaluationError: If the evaluator does not accept the counts.
        """
        path = own_file(self.folder / COUNTS_FILE)
        evaluator = self.setup.evaluator().resume(path)
        try:
            for token in evaluator.tokens:
                check_token(token)
            evaluator.compute()
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            fault = f"{type(error).__name__}: {shortened(str(error))}"
            raise ResultsError(
                f"{path}: does not contain counts of its protocol ({fault}); evaluate again"
            ) from error
        return evaluator

    def results_copy(self) -> Path | None:
        """Return the path of the copy of the results in the bundle; None if there is no copy.

        Raises:
            ResultsError: If the copy is invalid, or contains links or pipes.
        """
        results_folder = self.folder / RESULTS_FOLDER
        if not os.path.lexists(results_folder):
            return None
        for name, irregular in entries_in(self.folder).items():
            if irregular and name.split("/")[0] == RESULTS_FOLDER:
                raise ResultsError(f"{self.folder}: {shortened(name)} is {irregular}; {_REMEDY}")
        paths = sorted(results_folder.iterdir()) if results_folder.is_dir() else []
        if len(paths) != 1:
            raise ResultsError(
                f"{results_folder}: expected one results file or folder, found {len(paths)}; "
                f"{_REMEDY}"
            )
        return paths[0]


def read_bundle(folder: Path) -> Bundle:
    """Open a bundle; raise ResultsError if this devkit cannot read it.

    A bundle can be opened even if the plug-in with its task is not installed; `summary["task"]` is
    the name of the task.
    """
    folder = path_of(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder}: no such folder; {_REMEDY}")
    path = folder / SUMMARY_FILE
    summary = read_json(path, SUMMARY_FORMAT)
    _as_record(path, summary, _Summary, _UNCLEAR)
    if is_task(summary["task"]):
        _read_setup(path, summary)
    names = ("split", "samples", "scope", "agents", "horizon")
    with _naming_summary(path):
        choices = {name: summary[name] for name in names}
        if choices["agents"] is not None:
            choices["agents"] = tuple(choices["agents"])
        selection = SampleSelection(**choices)
    return Bundle(folder=folder, summary=summary, selection=selection)


def _read_setup(path: Path, summary: ReadOnlyValues) -> EvaluationSetup:
    """Build the setup that a summary states; raise ResultsError if it is invalid."""
    names = ("task", "protocol", "switches", "horizon")
    with _naming_summary(path):
        return EvaluationSetup(**{name: summary[name] for name in names})


@contextmanager
def _naming_summary(path: Path) -> Iterator[None]:
    """Turn errors that are caused by invalid values into a ResultsError that names the summary."""
    # errors that the value of a switch can cause
    errors = (ArithmeticError, LookupError, TypeError, ValueError)
    try:
        yield
    except errors as error:
        fault = shortened(str(error), MAX_REASON_LENGTH)
        raise ResultsError(f"{path}: {_UNCLEAR}{fault}; {_REMEDY}") from error


def chosen_threshold(folder: Path, by: Chooser, tokens: Iterable[str]) -> float:
    """Return the threshold that a warning evaluation on another split suggests.

    It is the best threshold for agents that are involved in the accident. A car does not know
    whether it will be involved, so all groups use the same threshold.

    Args:
        folder: Folder of the bundle with the evaluation.
        by: Rule that chooses the threshold.
        tokens: Tokens of the samples that the threshold is used for.

    Raises:
        ResultsError: If the folder does not contain a bundle.
        EvaluationError: If the bundle has another task or protocol, evaluates a scenario of these
            samples or its twin, or has no threshold.
    """
    bundle = read_bundle(folder)
    setup = bundle.setup
    if (setup.task, setup.protocol) != ("warning", "clean"):
        raise EvaluationError(
            f"{folder}: is an evaluation of {setup.task} {setup.protocol}; expected one of "
            "warning, protocol clean"
        )
    clusters = set(map(cluster_of, bundle.scenarios()))
    for scenario in sorted(set(map(scenario_of, tokens))):
        if cluster_of(scenario) in clusters:
            raise EvaluationError(
                f"{folder}: also evaluates {scenario} or its twin, and a threshold chosen on the "
                "evaluated recordings gives numbers that are too good; give an evaluation of "
                "another split, such as train or val"
            )
    threshold = _stored_threshold(bundle, folder, by)
    if not isinstance(threshold, float) or not math.isfinite(threshold):
        raise EvaluationError(
            f"{folder}: found no threshold by {by}; choose another rule, or set one with --switch "
            "threshold=…"
        )
    return threshold


def _stored_threshold(bundle: Bundle, folder: Path, by: Chooser) -> Any:
    """Return the threshold in a summary, unchecked; raise ResultsError if it is missing."""
    part = "metrics"
    key = str(by)
    fault = "no warning metrics; evaluate again"
    if by == "braking":
        part = "prevented"
        key = "quiet_braking"
        fault = "no prevented accidents; evaluate again with --prevented"
    try:
        groups: ReadOnlyValues = bundle.summary[part]["groups"]
        for group in GROUPS:
            if group in groups:
                return groups[group][key]
    except (LookupError, TypeError) as error:
        raise ResultsError(f"{folder}: its summary has {fault}") from error
    return None


def _as_record(path: Path, content: object, record_type: type[Record], prefix: str = "") -> Record:
    """Convert parsed JSON to a record; raise ResultsError, with a prefix, if it is invalid."""
    try:
        return as_record(content, record_type)
    except ValueError as error:
        raise ResultsError(f"{path}: {prefix}{error}; {_REMEDY}") from error


def own_file(path: Path) -> Path:
    """Return the path of a bundle's file; raise ResultsError if it is a link."""
    if path.is_symlink():
        raise ResultsError(f"{path}: is a link, which is not followed; {_REMEDY}")
    return path


def read_json(path: Path, expected: str | None) -> NamedValues:
    """Read a bundle's JSON file; raise ResultsError if it is missing or invalid.

    Args:
        path: Path of the file.
        expected: Name of the expected format; None for the counts, which do not state one.
    """
    try:
        text = read_bytes(own_file(path), "bundle" if expected else "results")
        content = parsed_json(text, constants=not expected)
    except FileNotFoundError as error:
        raise ResultsError(f"{path}: is missing; {_REMEDY}") from error
    except (OSError, ValueError) as error:
        if isinstance(error, ResultsError):
            raise
        raise ResultsError(f"{path}: {fault_text(error)}; {_REMEDY}") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{path}: expected an object, found {type(content).__name__}; {_REMEDY}")
    if expected is not None:
        _check_format(path, content, expected)
    return content


def _check_format(path: Path, content: ReadOnlyValues, expected: str) -> None:
    """Raise ResultsError unless a file has the expected format and a version that we can read."""
    stored_format = content.get("format")
    if stored_format != expected:
        raise ResultsError(
            f"{path}: expected the format {expected!r}, found {shortened(repr(stored_format))}; "
            f"{_REMEDY}"
        )
    if content.get("version") != SUMMARY_VERSION:
        version = shortened(repr(content.get("version")))
        writer = shortened(repr(content.get("devkit_version")))
        raise ResultsError(
            f"{path}: has version {version}, but this devkit reads {SUMMARY_VERSION}; use the "
            f"devkit that wrote it ({writer})"
        )


def entries_in(folder: Path) -> dict[str, str | None]:
    """List all files in a folder and the folders below it, sorted by relative path.

    Links are not followed.

    Returns:
        Relative path → None for a regular file, otherwise the kind of the entry, such as `a link`.
    """
    entries = {}
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            mode = path.lstat().st_mode
            if not stat.S_ISDIR(mode):
                irregular = "a link" if stat.S_ISLNK(mode) else irregular_text(mode)
                entries[path.relative_to(folder).as_posix()] = irregular
    return dict(sorted(entries.items()))


def checksums_of(folder: Path, listed: Collection[str] | None = None) -> dict[str, str]:
    """Compute the checksum of each file in a bundle, except for the list of files itself.

    Files that are not listed, links, pipes and unreadable files have a text instead of a checksum.

    Args:
        folder: Folder of the bundle.
        listed: Files that may be opened; None for all.
    """
    checksums = {}
    for name, irregular in entries_in(folder).items():
        if name == FILES_FILE:
            continue
        path = folder / name
        if listed is None:
            checksums[name] = file_checksum(path)
        elif irregular:
            checksums[name] = irregular
        elif name in listed:
            checksums[name] = _try_checksum(path)
        else:
            checksums[name] = "a file that is not listed"
    return checksums


def _try_checksum(path: Path) -> str:
    """Return the checksum of a file, or a text that explains why it cannot be read."""
    try:
        check_size(path.stat().st_size, "results")  # the largest kind of file in a bundle
        return file_checksum(path)
    except OSError as error:
        return fault_text(error)


def save_run(
    run: EvaluationRun,
    folder: PathType,
    *,
    include_results: bool = False,
    overwrite: bool = False,
    extras: Sequence[Callable[[Path], object]] = (),
) -> Path:
    """Write a bundle and return its path; if an error occurs, the folder stays as it was.

    The bundle contains `metrics_summary.json` (`EvaluationRun.summary`), `counts.json` (the counts
    of each sample), `samples.parquet` (`sample_rows`), `scenarios.json` (hashes of the truth),
    `files.json` (checksums of all files) and the output of the extras. Each file states the
    devkit's version and the protocol, and whether the run is partial.

    Args:
        run: Evaluation to write.
        folder: Folder of the bundle: new, empty, or with `overwrite` an earlier bundle.
        include_results: Whether to copy the results into the bundle's folder `results`, so that the
            bundle can be checked without other files.
        overwrite: Whether to replace an earlier bundle. Other folders are never replaced.
        extras: Functions that add a report or pictures; each is called with the folder that is
            being written.

    Raises:
        ResultsError: If the folder contains something other than a bundle or cannot be written, or
            if the results to copy are missing.
    """
    target = checked_target(folder, overwrite=overwrite)
    old_bundle: Path | None = None
    try:
        with replacing_folder(target) as temporary:
            _write_files(run, temporary, include_results=include_results)
            for extra in extras:
                extra(temporary)
            files = {"files": checksums_of(temporary)}
            _write_json(temporary / FILES_FILE, FILES_FORMAT, run, files)
            old_bundle = _move_aside(target)
    except OSError as error:
        raise ResultsError(
            f"{target}: cannot be written ({error}); free space there, or choose another folder"
        ) from error
    finally:
        if old_bundle is not None and not target.exists():
            old_bundle.rename(target)
        elif old_bundle is not None:
            remove_in(old_bundle.parent, old_bundle.name)
    remove_checkpoints(target)
    return target


def checked_target(
    folder: PathType,
    *,
    overwrite: bool = False,
    requested: Mapping[str, Any] | None = None,
) -> Path:
    """Check that a bundle can be written to a folder, and return the folder's path.

    Args:
        folder: Folder to write to.
        overwrite: Whether an earlier bundle may be replaced.
        requested: Values of the new summary; the message names the ones that differ from an earlier
            bundle.

    Raises:
        ResultsError: If the folder contains something other than a bundle, a bundle that must not
            be replaced, or a bundle with files that do not belong to it.
    """
    target = path_of(folder, "out: expected a folder", error=ResultsError).absolute()
    if not target.exists():
        return target
    if not target.is_dir():
        raise ResultsError(f"{target}: is a file; choose a new folder")
    entries = entries_in(target)
    if not entries:
        return target
    try:
        bundle = read_bundle(target)
        own_names = {*bundle.checksums(), FILES_FILE}
    except ResultsError as error:
        raise ResultsError(
            f"{target}: is not empty and contains no evaluation ({error}); choose a new folder"
        ) from error
    foreign = [name for name in entries if name not in own_names]
    if foreign:
        raise ResultsError(
            f"{target}: contains {foreign[0]}, which is not part of its evaluation; move it, or "
            "choose another folder"
        )
    if overwrite:
        return target
    requested = requested or {}
    stored_settings = {**bundle.summary, "results": bundle.summary["results"]["path"]}
    stored_values = {name: stored_settings[name] for name in requested}
    difference = differing_text(stored_values, requested)
    if difference:
        difference = f" ({difference})"
    raise ResultsError(
        f"{target}: contains an evaluation{difference}; pass overwrite=True (--overwrite) to "
        "replace it, or choose another folder"
    )


def _move_aside(target: Path) -> Path | None:
    """Rename an earlier bundle and return its new path; None if there is no earlier bundle."""
    if not target.is_dir() or not any(target.iterdir()):
        return None
    return target.rename(temporary_path(target))


def _write_files(run: EvaluationRun, folder: Path, *, include_results: bool) -> None:
    """Write all files of a bundle except for the list of files."""
    summary = json.dumps(run.summary(), indent=1, ensure_ascii=False)
    (folder / SUMMARY_FILE).write_text(summary, encoding="utf-8")
    counts_path = folder / COUNTS_FILE
    run.evaluator.save(counts_path)
    counts = json.loads(counts_path.read_text(encoding="utf-8"))
    counts_path.write_text(json.dumps(run.stamp | counts), encoding="utf-8")
    write_rows(folder / ROWS_FILE, sample_rows(run), run.stamp)
    scenarios = {"scenarios": dict(run.release.scenarios)}
    _write_json(folder / SCENARIOS_FILE, SCENARIOS_FORMAT, run, scenarios)
    if include_results:
        _copy_results(Path(run.results.path), folder / RESULTS_FOLDER)


def _write_json(path: Path, format_name: str, run: EvaluationRun, content: ReadOnlyValues) -> None:
    """Write a JSON file that contains the format's name, the run's stamp and `content`."""
    payload = {"format": format_name, "version": SUMMARY_VERSION, **run.stamp, **content}
    path.write_text(json.dumps(payload, indent=1, default=asdict), encoding="utf-8")


def _copy_results(source: Path, folder: Path) -> None:
    """Copy a results file or folder into a new folder."""
    folder.mkdir()
    if source.is_dir():
        shutil.copytree(source, folder / source.name)
    else:
        shutil.copy2(source, folder / source.name)
