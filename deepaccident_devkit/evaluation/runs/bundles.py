"""Bundles: an evaluation's folder, from which others can check and compare its numbers: written, read and checked."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.runs.evaluation_run import (
    SUMMARY_FORMAT,
    SUMMARY_VERSION,
    EvaluationRun,
    remove_checkpoints,
)
from deepaccident_devkit.evaluation.runs.rows import sample_rows, write_rows
from deepaccident_devkit.evaluation.runs.selection import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.files import file_checksum, replacing_folder, temporary_path
from deepaccident_devkit.reading import irregular_text

SUMMARY_FILE: Final = "metrics_summary.json"
COUNTS_FILE: Final = "counts.json"
ROWS_FILE: Final = "samples.parquet"
SCENARIOS_FILE: Final = "scenarios.json"
FILES_FILE: Final = "files.json"
RESULTS_FOLDER: Final = "results"
SCENARIOS_FORMAT: Final = "DeepAccident scenario hashes"
FILES_FORMAT: Final = "DeepAccident evaluation bundle"
_REMEDY: Final = "give a folder that `deepaccident evaluate … --out` wrote, or evaluate again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle(ShortRepr):
    """What `deepaccident evaluate … --out DIR` wrote, by its summary; the other files are read when needed.

    Attributes:
        folder: where.
        summary: of `metrics_summary.json`.
    """

    folder: Path
    summary: Mapping[str, Any]

    @property
    def setup(self) -> EvaluationSetup:
        """Task and rules; raises ResultsError if the summary does not say them."""
        try:
            return EvaluationSetup(
                task=self.summary["task"],
                protocol=self.summary["protocol"],
                switches=self.summary["switches"],
                horizon=self.summary["horizon"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise self._damaged(error) from error

    @property
    def selection(self) -> SampleSelection:
        """Which samples; raises ResultsError if the summary does not say."""
        try:
            agents = self.summary["agents"]
            return SampleSelection(
                agents=None if agents is None else tuple(agents),
                **{name: self.summary[name] for name in ("split", "samples", "scope", "horizon")},
            )
        except (KeyError, TypeError, ValueError) as error:
            raise self._damaged(error) from error

    @property
    def dataroot(self) -> Path:
        """The release that it was evaluated with; raises ResultsError if the summary does not say."""
        return Path(self._text("release", "dataroot"))

    @property
    def release_version(self) -> str:
        """`v1` or `v1-mini`; raises ResultsError if the summary does not say."""
        return self._text("release", "version")

    @property
    def results_path(self) -> Path:
        """The results: the copy in the bundle where there is one, else where they were.

        Raises:
            ResultsError: the summary does not say where, or a copy is not what it should be.
        """
        copies = self.folder / RESULTS_FOLDER
        if not copies.is_dir():
            return Path(self._text("results", "path"))
        inside = sorted(copies.iterdir())
        if len(inside) != 1:
            raise ResultsError(f"{copies}: expected one results file or folder, found {len(inside)}; {_REMEDY}")
        return inside[0]

    def scenarios(self) -> dict[str, dict[str, str | None]]:
        """Scenario → hashes of its label, meta and calib files; raises ResultsError."""
        path = self.folder / SCENARIOS_FILE
        stored = read_json(path, SCENARIOS_FORMAT).get("scenarios")
        if not isinstance(stored, dict) or not all(isinstance(each, dict) for each in stored.values()):
            raise ResultsError(f"{path}: expected scenarios with their hashes; {_REMEDY}")
        return stored

    def checksums(self) -> dict[str, str]:
        """File → checksum of all that was written, except the list itself; raises ResultsError."""
        path = self.folder / FILES_FILE
        stored = read_json(path, FILES_FORMAT).get("files")
        if not isinstance(stored, dict):
            raise ResultsError(f"{path}: expected files with their checksums; {_REMEDY}")
        return stored

    def _text(self, part: str, name: str) -> str:
        try:
            value = self.summary[part][name]
        except (KeyError, TypeError) as error:
            raise self._damaged(error) from error
        if not isinstance(value, str):
            raise self._damaged(f"{part}/{name} is no text: {value!r}")
        return value

    def _damaged(self, reason: object) -> ResultsError:
        return ResultsError(f"{self.folder / SUMMARY_FILE}: does not say what was evaluated ({reason}); {_REMEDY}")


def read_bundle(folder: Path) -> Bundle:
    """Open a bundle; raises ResultsError if there is none that this devkit can read."""
    if not folder.is_dir():
        raise ResultsError(f"{folder}: no such folder; {_REMEDY}")
    return Bundle(folder=folder, summary=read_json(folder / SUMMARY_FILE, SUMMARY_FORMAT))


def read_json(path: Path, expected: str | None) -> dict[str, Any]:
    """One of a bundle's JSON files, of a format; None for any object. Raises ResultsError."""
    try:
        odd = irregular_text(path.stat().st_mode)
        if odd:
            raise ResultsError(f"{path}: is {odd}; {_REMEDY}")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ResultsError(f"{path}: is missing; {_REMEDY}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ResultsError(f"{path}: cannot be read ({error}); {_REMEDY}") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{path}: expected an object, found {type(content).__name__}; {_REMEDY}")
    found = content.get("format")
    if expected is None:
        return content
    if found != expected:
        raise ResultsError(f"{path}: expected the format {expected!r}, found {found!r}; {_REMEDY}")
    if content.get("version") != SUMMARY_VERSION:
        raise ResultsError(
            f"{path}: is of version {content.get('version')!r}, this devkit reads {SUMMARY_VERSION}; use the devkit "
            f"that wrote it ({content.get('devkit_version')})"
        )
    return content


def names_in(folder: Path) -> list[str]:
    """The files in a folder and those below it, by their paths in it, in order."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def checksums_of(folder: Path) -> dict[str, str]:
    """File, as of `names_in` → checksum, of all but the list of files itself."""
    return {name: file_checksum(folder / name) for name in names_in(folder) if name != FILES_FILE}


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
            _write_json(temporary / FILES_FILE, FILES_FORMAT, run, {"files": checksums_of(temporary)})
            before = _moved_aside(target)
    except OSError as error:
        raise ResultsError(f"{target}: cannot be written ({error}); make room there, or choose another") from error
    finally:
        if before is not None and not target.exists():
            before.rename(target)
        elif before is not None:
            shutil.rmtree(before)
    remove_checkpoints(target)
    return target


def checked_target(folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """The path of a folder that a bundle can be written to; changes nothing.

    Raises:
        ResultsError: something lies there that is no bundle, or one that is not to be replaced, or one with files that
            are not its own.
    """
    if not os.fspath(folder):
        raise ResultsError("out: expected a folder, found an empty path; give '.' for the current one")
    target = Path(folder).expanduser().absolute()
    if not target.exists():
        return target
    if not target.is_dir():
        raise ResultsError(f"{target}: is a file; choose a folder that is new")
    found = names_in(target)
    if not found:
        return target
    try:
        bundle = read_bundle(target)
        own = {*bundle.checksums(), FILES_FILE}
    except ResultsError as error:
        raise ResultsError(f"{target}: is not empty and holds no evaluation ({error}); choose a new folder") from error
    foreign = [name for name in found if name not in own]
    if foreign:
        raise ResultsError(f"{target}: holds {foreign[0]}, which is not of its evaluation; move it, or choose another")
    if not overwrite:
        raise ResultsError(f"{target}: holds an evaluation; pass overwrite=True (--overwrite) to replace it")
    return target


def _moved_aside(target: Path) -> Path | None:
    """Where an earlier bundle now lies, beside its place; None if there is none."""
    if not target.is_dir() or not any(target.iterdir()):
        return None
    aside = temporary_path(target)
    target.rename(aside)
    return aside


def _write(run: EvaluationRun, folder: Path, *, include_results: bool) -> None:
    (folder / SUMMARY_FILE).write_text(json.dumps(run.summary(), indent=1, ensure_ascii=False), encoding="utf-8")
    run.evaluator.save(folder / COUNTS_FILE)
    counts = json.loads((folder / COUNTS_FILE).read_text(encoding="utf-8"))
    (folder / COUNTS_FILE).write_text(json.dumps(run.stamp | counts), encoding="utf-8")
    write_rows(folder / ROWS_FILE, sample_rows(run), run.stamp)
    hashes = {token: each.as_dict() for token, each in run.release.scenarios.items()}
    _write_json(folder / SCENARIOS_FILE, SCENARIOS_FORMAT, run, {"scenarios": hashes})
    if include_results:
        _copy(Path(run.results.path), folder / RESULTS_FOLDER)


def _write_json(path: Path, name: str, run: EvaluationRun, content: Mapping[str, Any]) -> None:
    stated = {"format": name, "version": SUMMARY_VERSION, **run.stamp, **content}
    path.write_text(json.dumps(stated, indent=1), encoding="utf-8")


def _copy(source: Path, folder: Path) -> None:
    folder.mkdir()
    if source.is_dir():
        shutil.copytree(source, folder / source.name)
    else:
        shutil.copy2(source, folder / source.name)
