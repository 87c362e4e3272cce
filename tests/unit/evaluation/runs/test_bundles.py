"""Bundles on disk: their content, and writing that succeeds as a whole or changes nothing."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.means import Sums
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    Partial,
    SampleSelection,
    evaluate_results,
    read_bundle,
    read_rows,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.support.reading import file_checksum
from deepaccident_devkit.support.version import __version__

FILES = {"metrics_summary.json", "counts.json", "samples.parquet", "scenarios.json", "files.json"}
MISFITS: dict[str, tuple[Callable[[Any], object], str]] = {
    "no task": (lambda summary: summary.pop("task"), "object missing required field `task`"),
    "agents": (
        lambda summary: summary.update(agents=3),
        r"expected `array \| null`, got `int` - at `\$.agents`",
    ),
    "an agent": (
        lambda summary: summary.update(agents=["ego_vehicle", 1]),
        r"expected `str`, got `int` - at `\$.agents",
    ),
    "a dataroot": (
        lambda summary: summary["release"].update(dataroot=3),
        r".* at `\$.release.dataroot`",
    ),
    "a long path": (
        lambda summary: summary["results"].update(path="x" * 5000),
        r".*length <= 1000 - at `\$.results.path",
    ),
    "no number": (
        lambda summary: summary["counts"].update(left_out=True),
        r".* got `bool` - at `\$.counts.left_out`",
    ),
    "a partial one": (
        lambda summary: summary.update(partial={"mark": "\x1b[2J"}),
        r".* at `\$.partial.mark`",
    ),
    "a second line": (lambda summary: summary.update(split="val\n"), r".* at `\$.split`"),
    "breakdowns": (
        lambda summary: summary["breakdowns"].update(all=[]),
        r"expected `object`, got `array` - at .*",
    ),
    "a task": (lambda summary: summary.update(task="x" * 900), "task: expected one of"),
    "a horizon of years": (
        lambda summary: summary.update(horizon=1e9),
        "horizon: expected seconds above 0, at most 100",
    ),
    "a switch": (
        lambda summary: summary.update(switches={"x" * 900: 1}),
        "these rules have no switch",
    ),
}
JSON_FILES = sorted(name for name in FILES if name.endswith(".json"))


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_a_bundle_holds_all_and_reads_back(
    run: EvaluationRun, results: Results, tmp_path: Path
) -> None:
    folder = save_run(run, tmp_path / "new" / "bundle")
    bundle = read_bundle(folder)

    assert {path.name for path in folder.iterdir()} == FILES
    assert bundle.summary == run.summary() == read_json(folder / "metrics_summary.json")
    assert (bundle.setup, bundle.selection) == (run.setup, run.selection)
    assert (str(bundle.dataroot), bundle.release_version) == (run.release.dataroot, "v1")
    assert bundle.results_path == results.path
    assert bundle.scenarios() == run.release.scenarios
    assert bundle.checksums() == {
        name: file_checksum(folder / name) for name in FILES - {"files.json"}
    }
    assert run.evaluator.fresh().resume(folder / "counts.json").compute() == run.result


def test_every_file_states_version_protocol_and_partial(run: EvaluationRun, tmp_path: Path) -> None:
    partial_run = replace(run, partial=Partial(missing=1, extra=0, expected=7, evaluated=6))
    folder = save_run(partial_run, tmp_path / "bundle")

    headers = [read_json(folder / name) for name in JSON_FILES]
    _, rows_header = read_rows(folder / "samples.parquet")
    for header in [*headers, rows_header]:
        assert header["devkit_version"] == __version__
        assert (header["task"], header["protocol"]) == ("accident", "boxes")
        assert header["partial"]["mark"] == "PARTIAL: 6 of 7 samples"


def test_the_summary_states_every_choice(run: EvaluationRun) -> None:
    setup = replace(run.setup, switches={"reading.danger_distance": 0.5})
    summary = replace(run, setup=setup).summary()

    assert summary["switches"] == {"reading.danger_distance": 0.5}
    assert summary["settings"]["choices"]["reading"]["danger_distance"] == 0.5
    assert summary["counts"] == {"samples": 6, "scenarios": 2, "left_out": 0}
    assert summary["metrics"]["positives"] == 3
    assert {"python", "numpy"} <= summary["environment"].keys()
    assert summary["headlines"][0]["name"] == "apa"


def test_a_folder_of_results_is_copied_whole(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_motion: Any
) -> None:
    results = write_motion(tmp_path / "motion", selection.tokens(da_b))
    run = evaluate_results(da_b, results, EvaluationSetup(task="motion"), selection, workers=1)

    folder = save_run(run, tmp_path / "bundle", include_results=True)
    copy = read_results(read_bundle(folder).results_path)
    copy.check()
    assert copy.fingerprint == results.fingerprint

    (folder / "results" / "another").mkdir()
    with pytest.raises(
        ResultsError, match=r"results: expected one results file or folder, found 2"
    ):
        _ = read_bundle(folder).results_path


def test_an_extra_that_fails_leaves_no_bundle(run: EvaluationRun, tmp_path: Path) -> None:
    def fail_to_plot(folder: Path) -> None:
        assert FILES - {"files.json"} <= {path.name for path in folder.iterdir()}
        raise KeyError("plot")

    assert_raises(
        (lambda: save_run(run, tmp_path / "bundle", extras=[fail_to_plot]), KeyError, "plot"),
    )
    assert not list(tmp_path.glob("*bundle*"))


def test_a_bundle_is_replaced_only_on_request_and_without_foreign_files(
    run: EvaluationRun, tmp_path: Path
) -> None:
    folder = save_run(run, tmp_path / "bundle")
    assert_raises(
        (
            lambda: save_run(run, folder),
            ResultsError,
            ("bundle: contains an evaluation", "--overwrite"),
        )
    )

    save_run(replace(run, sanity={"warnings": []}), folder, overwrite=True)
    assert read_bundle(folder).summary["sanity"] == {"warnings": []}
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["bundle"]

    (folder / "thoughts.txt").write_text("mine")
    assert_raises(
        (lambda: save_run(run, folder, overwrite=True), ResultsError, ("thoughts.txt", "move it"))
    )


def test_a_link_to_a_bundle_is_replaced_itself(run: EvaluationRun, tmp_path: Path) -> None:
    folder = save_run(run, tmp_path / "bundle")
    (tmp_path / "latest").symlink_to(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    save_run(replace(run, sanity={}), tmp_path / "latest", overwrite=True)

    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert read_bundle(tmp_path / "latest").summary["sanity"] == {}


def test_the_earlier_bundle_stays_if_the_new_one_fails(
    run: EvaluationRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = save_run(run, tmp_path / "bundle")
    checksums = {name: file_checksum(folder / name) for name in FILES}
    replace_file = os.replace

    def fail_at_the_bundle(source: Path, target: Path) -> None:
        if target == folder:
            raise OSError(28, "No space left on device")
        replace_file(source, target)

    monkeypatch.setattr("deepaccident_devkit.support.files.os.replace", fail_at_the_bundle)
    assert_raises(
        (
            lambda: save_run(replace(run, sanity={}), folder, overwrite=True),
            ResultsError,
            r"bundle: cannot be written \(.*No space left",
        ),
    )
    assert {name: file_checksum(folder / name) for name in FILES} == checksums


@pytest.mark.parametrize("overwrite", [False, True])
def test_another_folder_is_never_replaced(
    run: EvaluationRun, tmp_path: Path, *, overwrite: bool
) -> None:
    folder = tmp_path / "work"
    file = folder / "deep" / "thesis.tex"
    file.parent.mkdir(parents=True)
    file.touch()

    assert_raises(
        (
            lambda: save_run(run, folder, overwrite=overwrite),
            ResultsError,
            r"work: is not empty and contains no evaluation",
        ),
        (
            lambda: save_run(run, file, overwrite=overwrite),
            ResultsError,
            r"thesis.tex: is a file; choose a new folder",
        ),
        (
            lambda: save_run(run, "", overwrite=overwrite),
            ResultsError,
            r"out: expected a folder, found an empty path",
        ),
    )


def test_an_empty_folder_is_fine_and_checkpoints_go(
    da_b: DeepAccident,
    results: Results,
    selection: SampleSelection,
    run: EvaluationRun,
    tmp_path: Path,
) -> None:
    out = tmp_path / "bundle"
    checkpoints = tmp_path / "bundle.unfinished"
    out.mkdir()

    checkpointed_run = evaluate_results(da_b, results, run.setup, selection, workers=1, out=out)
    assert checkpoints.is_dir()

    save_run(checkpointed_run, out)
    assert not checkpoints.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"metrics_summary.json: is missing; give a folder that"),
        ("{", r"metrics_summary.json: is not JSON \(line 1"),
        ("[]", r"metrics_summary.json: expected an object, found list"),
        (
            '{"format": "nuScenes"}',
            r"expected the format 'DeepAccident metrics summary', found 'nuScenes'",
        ),
        (
            '{"format": "DeepAccident metrics summary", "version": 9, "devkit_version": "7.0"}',
            r"has version 9, but this devkit reads 1; use the devkit that wrote it \('7.0'\)",
        ),
    ],
)
def test_a_file_that_is_no_summary(
    run: EvaluationRun, tmp_path: Path, content: str | None, message: str
) -> None:
    path = save_run(run, tmp_path / "bundle") / "metrics_summary.json"
    if content is None:
        path.unlink()
    else:
        path.write_text(content)

    assert_raises(
        (lambda: read_bundle(path.parent), ResultsError, message),
    )


@pytest.mark.parametrize("fault", MISFITS)
def test_a_summary_against_its_schema(run: EvaluationRun, tmp_path: Path, fault: str) -> None:
    change, reason = MISFITS[fault]
    folder = save_run(run.broken_down(["all"]), tmp_path / "bundle")
    path = folder / "metrics_summary.json"
    summary = read_json(path)
    change(summary)
    path.write_text(json.dumps(summary), encoding="utf-8")

    message = rf"metrics_summary.json: does not say what was evaluated: {reason}"
    with pytest.raises(ResultsError, match=message):
        # a bundle may be of a plug-in's task: an unknown one is refused only here
        _ = read_bundle(folder).setup


DAMAGES: dict[str, Callable[[Any], object]] = {
    "no names": lambda counts: counts.pop("names"),
    "names that are none": lambda counts: counts.update(names=7),
    "names that move a cursor": lambda counts: counts.update(
        names=counts["names"].replace("given", "\x1b[2J", 1)
    ),
    "names of no table": lambda counts: counts.update(names=counts["names"].replace("/", "-")),
    "too many names": lambda counts: counts.update(names=counts["names"] + "\nmore"),
    "no numbers": lambda counts: counts.pop("numbers"),
    "numbers of three": lambda counts: counts["numbers"][0].append(1.0),
    "words for numbers": lambda counts: counts.update(
        numbers=[["a", "b"]] * len(counts["numbers"])
    ),
    "no notes": lambda counts: counts.pop("notes"),
    "notes that are no numbers": lambda counts: counts.update(notes={"{sample}": "many"}),
    "samples that are none": lambda counts: counts.update(samples=[]),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("task", ["planning", "forecasting"])
def test_damaged_counts_of_means(
    run: EvaluationRun, tmp_path: Path, task: str, damage: str
) -> None:
    setup = EvaluationSetup(task=task, protocol="clean")
    column = "avoided" if task == "planning" else "min_fde"
    sums = Sums()
    for table in ("1 s", "2 s"):
        sums.add(table, "given", column, 1.0)

    evaluator = setup.evaluator()
    evaluator.add("a/b/ego_vehicle/001", sums.counts())
    path = evaluator.save(tmp_path / "counts.json")
    saved = read_bundle(save_run(run, tmp_path / "run"))
    bundle = replace(saved, folder=tmp_path, summary={**saved.summary, **setup.as_dict()})
    assert bundle.evaluator().compute().samples == 1

    content = read_json(path)
    DAMAGES[damage](content["counts"]["a/b/ego_vehicle/001"])
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises((ResultsError, EvaluationError), match=r"counts.json: ") as caught:
        bundle.evaluator()
    assert "\x1b" not in str(caught.value)


def test_scenarios_without_hashes_are_refused(run: EvaluationRun, tmp_path: Path) -> None:
    bundle = read_bundle(save_run(run, tmp_path / "run"))
    path = bundle.folder / "scenarios.json"
    path.write_text(json.dumps({**read_json(path), "scenarios": ["s"]}), encoding="utf-8")

    assert_raises(
        (
            bundle.scenarios,
            ResultsError,
            r"scenarios.json: expected `object`, got `array` - at `\$.scenarios`",
        ),
    )
