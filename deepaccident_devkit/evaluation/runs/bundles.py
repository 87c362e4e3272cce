"""Bundles: folders of evaluations, with numbers that others can check and compare."""

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
# A name, a path or a checksum that a terminal can show in one line.
Line = Annotated[
    str,
    msgspec.Meta(
        max_length=1000,
        pattern=r"^[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]*\Z",
    ),
]
# Rule that chooses a threshold: the best F1; at most one second a minute in false alarm; or at most
# one second a minute of braking for false alarms, which the evaluation of prevented accidents
# finds.
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
    """The parts of `metrics_summary.json` that are used, and not only compared."""

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
    """Content of `scenarios.json`: scenario → hashes of its label, meta and calib files."""

    scenarios: dict[Line, ScenarioHashes]


class _Files(msgspec.Struct):
    """Content of `files.json`: file → checksum."""

    files: dict[Line, Line]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle(ShortRepr):
    """Output of `deepaccident evaluate … --out DIR`: the summary; other files are read when needed.

    Attributes:
        folder: Folder of the bundle.
        summary: Content of `metrics_summary.json`.
        selection: The evaluated samples.
    """

    folder: Path
    summary: Mapping[str, Any]
    selection: SampleSelection

    @property
    def setup(self) -> EvaluationSetup:
        """Task and rules; raises ResultsError if the plug-in that has the task is not installed."""
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
        """Path of the results: the copy in the bundle if there is one, otherwise the original.

        Raises:
            ResultsError: the copy is invalid.
        """
        return self.results_copy() or Path(self.summary["results"]["path"])

    def outside_paths(self) -> dict[str, str]:
        """Return the paths in the summary that lead out of the bundle.

        `verify_bundle` opens them only if they are passed as arguments.

        Returns:
            `dataroot`; `results`, where the bundle has no copy of them; `split`, where it is a
                split file.

        Raises:
            ResultsError: the copy of the results is invalid.
        """
        paths = {"dataroot": self.dataroot}
        if self.results_copy() is None:
            paths["results"] = self.summary["results"]["path"]
        if self.summary["split"] not in SPLIT_CHOICES:
            paths["split"] = self.summary["split"]
        return paths

    def scenarios(self) -> dict[str, ScenarioHashes]:
        """Return the hashes of each scenario's label, meta and calib files; raises ResultsError."""
        return _read_record(self.folder / SCENARIOS_FILE, SCENARIOS_FORMAT, _Scenarios).scenarios

    def checksums(self) -> dict[str, str]:
        """Return file → checksum of all files except the list itself; raises ResultsError."""
        return _read_record(self.folder / FILES_FILE, FILES_FORMAT, _Files).files

    def counts(self) -> dict[str, Any]:
        """Return token → stored counts of the sample; raises ResultsError."""
        path = self.folder / COUNTS_FILE
        counts = read_json(path, None).get("counts")
        if not isinstance(counts, dict):
            raise ResultsError(f"{path}: holds no counts; {_REMEDY}")
        return counts

    def rows(self) -> dict[str, Row]:
        """Return token → row of the sample; raises ResultsError."""
        path = own_file(self.folder / ROWS_FILE)
        rows, _ = read_rows(path)
        if any(not isinstance(row.get("token"), str) for row in rows):
            raise ResultsError(f"{path}: has rows without a sample's token; {_REMEDY}")
        return {row["token"]: row for row in rows}

    def evaluator(self) -> Evaluator[Any]:
        """Return all counts, to compute results from; raises ResultsError or EvaluationError."""
        path = own_file(self.folder / COUNTS_FILE)
        evaluator = self.setup.evaluator().resume(path)
        try:
            for token in evaluator.tokens:
                check_token(token)
            evaluator.compute()
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            fault = f"{type(error).__name__}: {shortened(str(error))}"
            raise ResultsError(
                f"{path}: does not hold counts of its protocol ({fault}); evaluate again"
            ) from error
        return evaluator

    def results_copy(self) -> Path | None:
        """Return the copy of the results in the bundle; None without one.

        Raises:
            ResultsError: the copy is invalid, or has links or pipes in it.
        """
        copies = self.folder / RESULTS_FOLDER
        if not os.path.lexists(copies):
            return None
        for name, irregular in entries_in(self.folder).items():
            if irregular and name.split("/")[0] == RESULTS_FOLDER:
                raise ResultsError(f"{self.folder}: {shortened(name)} is {irregular}; {_REMEDY}")
        paths = sorted(copies.iterdir()) if copies.is_dir() else []
        if len(paths) != 1:
            raise ResultsError(
                f"{copies}: expected one results file or folder, found {len(paths)}; {_REMEDY}"
            )
        return paths[0]


def read_bundle(folder: Path) -> Bundle:
    """Open a bundle; raises ResultsError if there is none that this devkit can read.

    A bundle also opens if its task belongs to a plug-in that is not installed: `summary["task"]`
    names the task.
    """
    folder = path_of(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder}: no such folder; {_REMEDY}")
    path = folder / SUMMARY_FILE
    summary = read_json(path, SUMMARY_FORMAT)
    _as_record(path, summary, _Summary, _UNCLEAR)
    if is_task(summary["task"]):
        _stated_setup(path, summary)
    names = ("split", "samples", "scope", "horizon")
    with _naming_summary(path):
        agents = None if summary["agents"] is None else tuple(summary["agents"])
        selection = SampleSelection(agents=agents, **{name: summary[name] for name in names})
    return Bundle(folder=folder, summary=summary, selection=selection)


def _stated_setup(path: Path, summary: Mapping[str, Any]) -> EvaluationSetup:
    """Return the setup in a summary; raises ResultsError."""
    names = ("task", "protocol", "switches", "horizon")
    with _naming_summary(path):
        return EvaluationSetup(**{name: summary[name] for name in names})


@contextmanager
def _naming_summary(path: Path) -> Iterator[None]:
    """Turn errors of impossible values into a ResultsError that names the summary."""
    # all errors that the value of a switch can cause
    errors = (ArithmeticError, LookupError, TypeError, ValueError)
    try:
        yield
    except errors as error:
        fault = shortened(str(error), MOST_TOLD)
        raise ResultsError(f"{path}: {_UNCLEAR}{fault}; {_REMEDY}") from error


def chosen_threshold(folder: Path, by: Chooser, tokens: Iterable[str]) -> float:
    """Return the threshold for samples that an evaluation of warnings of another split chose.

    It is the best threshold for involved agents. A car does not know whether it will be involved,
    so there is a single threshold for all groups.

    Raises:
        ResultsError: there is no bundle.
        EvaluationError: it is of another task or protocol, has a scenario of these samples or its
            twin, or found no threshold.
    """
    bundle = read_bundle(folder)
    kind = bundle.setup.task, bundle.setup.protocol
    if kind != ("warning", "clean"):
        raise EvaluationError(
            f"{folder}: is an evaluation of {' '.join(kind)}; expected one of warning, protocol "
            "clean"
        )
    clusters = set(map(cluster_of, bundle.scenarios()))
    scenarios = set(map(scenario_of, tokens))
    shared = sorted(scenario for scenario in scenarios if cluster_of(scenario) in clusters)
    if shared:
        raise EvaluationError(
            f"{folder}: is an evaluation of {shared[0]} or its twin, too; a threshold that is "
            "chosen on the recordings it is tried on flatters: give one of another split, such as "
            "train or val"
        )
    threshold = _stored_threshold(bundle, folder, by)
    if not isinstance(threshold, float) or not math.isfinite(threshold):
        raise EvaluationError(
            f"{folder}: found no threshold by {by}; choose another, or give one with --switch "
            "threshold=…"
        )
    return threshold


def _stored_threshold(bundle: Bundle, folder: Path, by: Chooser) -> Any:
    """Return the stored threshold, which may be of any type; raises ResultsError."""
    part, key, missing, option = "metrics", str(by), "metrics of warnings", ""
    if by == "braking":
        part, key = "prevented", "quiet_braking"
        missing, option = "prevented accidents", " with --prevented"
    try:
        groups: Mapping[str, Any] = bundle.summary[part]["groups"]
        group = next((name for name in GROUPS if name in groups), None)
        if group is None:
            return None
        return groups[group][key]
    except (LookupError, TypeError) as error:
        raise ResultsError(
            f"{folder}: its summary has no {missing}; evaluate again{option}"
        ) from error


def _read_record(path: Path, form: str, record_type: type[Record]) -> Record:
    """Return the content of a bundle's JSON file; raises ResultsError."""
    return _as_record(path, read_json(path, form), record_type)


def _as_record(path: Path, content: object, record_type: type[Record], prefix: str = "") -> Record:
    """Return parsed JSON as a record; raises ResultsError, with the prefix before the fault."""
    try:
        return as_record(content, record_type)
    except ValueError as error:
        raise ResultsError(f"{path}: {prefix}{error}; {_REMEDY}") from error


def own_file(path: Path) -> Path:
    """Return the path of a bundle's file; raises ResultsError if it is a link."""
    if path.is_symlink():
        raise ResultsError(f"{path}: is a link, which is not followed; {_REMEDY}")
    return path


def read_json(path: Path, expected: str | None) -> dict[str, Any]:
    """Return a JSON file of a bundle; raises ResultsError.

    Args:
        path: Path of the file.
        expected: Its format; None for the counts.
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


def _check_format(path: Path, content: Mapping[str, Any], expected: str) -> None:
    """Raise ResultsError unless a file is of the expected format and of this devkit's version."""
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
            f"{path}: is of version {version}, this devkit reads {SUMMARY_VERSION}; use the devkit "
            f"that wrote it ({writer})"
        )


def entries_in(folder: Path) -> dict[str, str | None]:
    """Return all files in a folder and in its folders, sorted by their relative paths.

    Links are not followed.

    Returns:
        Relative path → what it is (`a link`) if it is not a regular file, otherwise None.
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
    """Return the checksum of each file of `entries_in`, except the list of files itself.

    Args:
        folder: Folder of the bundle.
        listed: Files that are opened; None for all. For other files, links, pipes, and unreadable
            files, words stand for the checksum.
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
        else:
            checksums[name] = _checksum(path) if name in listed else "a file that is not listed"
    return checksums


def _checksum(path: Path) -> str:
    """Return the checksum of a file, or why it cannot be read."""
    try:
        check_size(path.stat().st_size, "results")  # the largest kind of file in a bundle
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
    """Write a bundle and return its path; if it fails, the folder stays as it was.

    The bundle holds `metrics_summary.json` (`EvaluationRun.summary`), `counts.json` (the
    evaluator's, by sample), `samples.parquet` (`sample_rows`), `scenarios.json` (hashes of the
    truth), `files.json` (checksums of all these) and the output of the extras. Each file has the
    devkit's version, the protocol, and whether it is partial.

    Args:
        run: The evaluation.
        folder: Folder of the bundle: new, empty, or with `overwrite` an earlier bundle.
        include_results: Whether to copy the results into its folder `results`, so that it can be
            checked by itself.
        overwrite: Whether to replace an earlier bundle. Other folders are never replaced.
        extras: Functions that are called in turn with the folder that is being written, to add a
            report or pictures.

    Raises:
        ResultsError: the folder holds something else or cannot be written, or the results to copy
            are missing.
    """
    target = checked_target(folder, overwrite=overwrite)
    before: Path | None = None
    try:
        with replacing_folder(target) as temporary:
            _write(run, temporary, include_results=include_results)
            for extra in extras:
                extra(temporary)
            files = {"files": checksums_of(temporary)}
            _write_json(temporary / FILES_FILE, FILES_FORMAT, run, files)
            before = _move_aside(target)
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
    requested: Mapping[str, Any] | None = None,
) -> Path:
    """Return the path of a folder that a bundle can be written to; changes nothing.

    Args:
        folder: The folder.
        overwrite: Whether an earlier bundle may be replaced.
        requested: Values of the new summary; a message names the ones that differ from the
            earlier bundle.

    Raises:
        ResultsError: the folder holds something other than a bundle, a bundle that must not be
            replaced, or a bundle with foreign files.
    """
    target = path_of(folder, "out: expected a folder", error=ResultsError).absolute()
    if not target.exists():
        return target
    if not target.is_dir():
        raise ResultsError(f"{target}: is a file; choose a folder that is new")
    entries = entries_in(target)
    if not entries:
        return target
    try:
        bundle = read_bundle(target)
        own_names = {*bundle.checksums(), FILES_FILE}
    except ResultsError as error:
        raise ResultsError(
            f"{target}: is not empty and holds no evaluation ({error}); choose a new folder"
        ) from error
    foreign = [name for name in entries if name not in own_names]
    if foreign:
        raise ResultsError(
            f"{target}: holds {foreign[0]}, which is not of its evaluation; move it, or choose "
            "another"
        )
    if not overwrite:
        requested = requested or {}
        stored = {**bundle.summary, "results": bundle.summary["results"]["path"]}
        text = differing_text({name: stored[name] for name in requested}, requested)
        raise ResultsError(
            f"{target}: holds an evaluation{f' ({text})' if text else ''}; pass overwrite=True "
            "(--overwrite) to replace it, or choose another folder"
        )
    return target


def _move_aside(target: Path) -> Path | None:
    """Rename an earlier bundle and return its new path; None if there is none."""
    if not target.is_dir() or not any(target.iterdir()):
        return None
    return target.rename(temporary_path(target))


def _write(run: EvaluationRun, folder: Path, *, include_results: bool) -> None:
    """Write all files of a bundle except the list of its files."""
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
        _copy(Path(run.results.path), folder / RESULTS_FOLDER)


def _write_json(
    path: Path, format_name: str, run: EvaluationRun, content: Mapping[str, Any]
) -> None:
    payload = {"format": format_name, "version": SUMMARY_VERSION, **run.stamp, **content}
    path.write_text(json.dumps(payload, indent=1, default=asdict), encoding="utf-8")


def _copy(source: Path, folder: Path) -> None:
    folder.mkdir()
    if source.is_dir():
        shutil.copytree(source, folder / source.name)
    else:
        shutil.copy2(source, folder / source.name)
