"""`save_run`: an evaluation written as a bundle, from which others can check and compare its numbers."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.runs.bundle_files import (
    COUNTS_FILE,
    FILES_FILE,
    FILES_FORMAT,
    RESULTS_FOLDER,
    ROWS_FILE,
    SCENARIOS_FILE,
    SCENARIOS_FORMAT,
    SUMMARY_FILE,
    checksums_of,
    names_in,
    read_bundle,
)
from deepaccident_devkit.evaluation.runs.checkpoints import remove_checkpoints
from deepaccident_devkit.evaluation.runs.details import sample_rows
from deepaccident_devkit.evaluation.runs.evaluation_run import SUMMARY_VERSION, EvaluationRun
from deepaccident_devkit.evaluation.runs.parquet import write_rows
from deepaccident_devkit.files import replacing_folder


def save_run(
    run: EvaluationRun,
    folder: str | os.PathLike[str],
    *,
    include_results: bool = False,
    overwrite: bool = False,
    extras: Sequence[Callable[[Path], object]] = (),
) -> Path:
    """Write a bundle: the folder is there with all of it, or as it was before; returns its path.

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
    aside = target.with_name(f".{target.name}.{os.getpid()}.old")
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
