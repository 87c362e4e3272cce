"""`deepaccident evaluate`, end to end: results in, numbers out, checked and compared again."""

import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from support.command_calls import invoke_command, run_command
from support.expected_errors import assert_raises
from support.report_page import read_report
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident, taxonomy
from deepaccident_devkit.errors import ChoiceError, EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, accident_context, instances_of
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import (
    SampleSelection,
    evaluate_results,
    read_bundle,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.support.human_names import metric_name

pytestmark = pytest.mark.slow

AGENTS = ("ego_vehicle", "infrastructure")
ALL_LABELLED_SAMPLES = ("--samples", "evaluate", "--scope", "all", "--resamples", "0")
SPLIT_AND_AGENTS = ("--split", "train", "--agents", ",".join(AGENTS), "--resamples", "0")


evaluate = partial(invoke_command, "evaluate")


def read_summary(result: Result) -> Any:
    """Return the JSON that a verb prints after its messages."""
    return json.loads(result.output[result.output.index("{") :])


def rename_recordings(bundle: Path) -> Path:
    """Make an evaluation look as if it were of other recordings."""
    path = bundle / "scenarios.json"
    content = json.loads(path.read_text())
    content["scenarios"] = {
        name.replace("_type001_", "_type009_"): scenario
        for name, scenario in content["scenarios"].items()
    }
    path.write_text(json.dumps(content))
    return bundle


@contextmanager
def change_text(path: Path, change: Callable[[str], str]) -> Iterator[None]:
    """Change a text file inside a `with` block."""
    old_text = path.read_text()
    path.write_text(change(old_text))
    try:
        yield
    finally:
        path.write_text(old_text)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files that several tests read, with a blank in its name."""
    return tmp_path_factory.mktemp("evaluate") / "my results"


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    return [
        token for token in da_motion.evaluation_samples("train") if token.split("/")[2] in AGENTS
    ]


def write_accidents(
    dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: float = 0.1
) -> Path:
    with ResultsWriter(path, "accident") as writer:
        for token in tokens:
            truth = accident_context(dataset, token, 2.0).truth
            alarms = []
            if truth is not None and truth.accident is not None:
                true = truth.accident
                alarms = [Accident(positions=true.positions + moved, time=true.time, ids=true.ids)]
            writer.add(token, alarms)
    return path


def write_motion(dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: int = 0) -> Path:
    with ResultsWriter(path, "motion", meta={"method": "<b>moved</b>"}) as writer:
        for token in tokens:
            label = dataset.motion_labels(token).to_present("bilinear")
            instance = np.roll(label.instance, moved, axis=2)
            writer.add(token, instances_of(instance, label.config.grid))
    return path


def write_boxes(dataset: DeepAccident, path: Path, tokens: Iterable[str]) -> Path:
    with ResultsWriter(path, "detection") as writer:
        for token in tokens:
            boxes = dataset.boxes(token)
            scores = np.linspace(0.1, 1, len(boxes))
            writer.add(token, DetectedBoxes(boxes=boxes, scores=scores))
    return path


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, folder: Path, tokens: list[str]) -> dict[str, Path]:
    """The true accidents moved a little, the motion labels moved by a column, the true boxes."""
    return {
        "accidents": write_accidents(da_motion, folder / "accidents.json", tokens),
        "motion": write_motion(da_motion, folder / "motion", tokens, moved=1),
        "boxes": write_boxes(da_motion, folder / "boxes.json", tokens),
    }


@pytest.fixture(scope="module")
def words(da_motion: DeepAccident, results: dict[str, Path]) -> tuple[object, ...]:
    """The words of a command that evaluates the accidents."""
    return (
        "accident",
        da_motion.dataroot,
        "--results",
        results["accidents"],
        *SPLIT_AND_AGENTS,
        "--protocol",
        "boxes",
    )


@pytest.fixture(scope="module")
def bundle(words: tuple[object, ...], folder: Path) -> Path:
    """An evaluation with all optional parts."""
    evaluate(*words, "--out", folder / "bundle", "--sanity", "--include-results")
    return folder / "bundle"


@pytest.mark.parametrize(
    ("task", "kind", "protocol", "headline"),
    [
        ("motion", "motion", "paper", "iou 30x30"),
        ("accident", "motion", "boxes", "average_precision"),
        ("accident", "accidents", "paper", "apa"),
        ("detection", "boxes", "opencood", "mAP"),
        ("warning", "accidents", "clean", "auc_ahead ego_involved"),
        ("warning", "accidents", "field", "AP ustring ego_involved"),
    ],
)
def test_every_task_and_protocol(
    da_motion: DeepAccident,
    results: dict[str, Path],
    task: str,
    kind: str,
    protocol: str,
    headline: str,
) -> None:
    samples = (*SPLIT_AND_AGENTS, "--samples", "evaluate", "--scope", "accident")
    words = (task, da_motion.dataroot, "--results", results[kind], *samples)
    text = evaluate(*words, "--protocol", protocol).output
    expected = (
        f"{task}, protocol {protocol}",
        "samples      8 from 1 scenario: split train",
        f"\n  {metric_name(headline)} ",
    )
    assert missing_parts(text, *expected) == []
    assert "PARTIAL" not in text


def test_a_bundle_with_all_parts(
    bundle: Path, results: dict[str, Path], da_motion: DeepAccident
) -> None:
    assert {path.name for path in bundle.iterdir()} == {
        *("metrics_summary.json", "counts.json", "samples.parquet", "scenarios.json", "files.json"),
        *("report.html", "figures", "results"),
    }
    summary = read_bundle(bundle).summary
    assert summary["sanity"]["samples"] == 8
    assert summary["release"]["dataroot"] == str(da_motion.dataroot)
    assert (bundle / "results" / "accidents.json").read_bytes() == results["accidents"].read_bytes()
    assert not bundle.with_name("bundle.unfinished").exists()


def test_several_processes_write_one_evaluation(
    words: tuple[object, ...], bundle: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ("--sanity", "--include-results", "--out", out)
    command = [sys.executable, "-m", "deepaccident_devkit.cli", "evaluate"]
    command += map(str, (*words, *options))
    pipe = subprocess.PIPE
    processes = [subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) for _ in range(2)]

    outputs = [process.communicate(timeout=300) for process in processes]

    if all(process.returncode == 0 for process in processes):
        assert all("samples      8 from 1 scenario: split train" in text for text, _ in outputs)
    else:  # one process began after the other had finished
        message = "contains an evaluation; pass overwrite=True"
        assert any(message in errors for _, errors in outputs), outputs
    names = [path.relative_to(bundle) for path in bundle.rglob("*") if path.is_file()]
    different = [
        name for name in names if (out / name).read_bytes() != (bundle / name).read_bytes()
    ]
    assert different == []
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_json_is_the_summary(words: tuple[object, ...], tmp_path: Path) -> None:
    out = tmp_path / "bundle"
    options = ("--by", "town", "--switch", "reading.danger_distance=0.5")
    result = evaluate(*words, *options, "--json", "--out", out)

    summary = json.loads(result.stdout)
    assert summary == read_bundle(out).summary
    assert [*summary["breakdowns"]] == ["all", "town"]
    assert summary["switches"] == {"reading.danger_distance": 0.5}
    assert f"wrote {out}" in result.stderr


@pytest.mark.parametrize(
    ("task", "protocol", "write", "line"),
    [
        ("motion", "released", write_motion, "IoU, 100 m × 100 m 100.00 %"),
        ("accident", "boxes", write_accidents, "APA 1.000"),
        ("detection", "released", write_boxes, "AP, car 97.22 %"),
        ("warning", "clean", write_accidents, "recall, ego involved in the accident 1.000"),
    ],
)
def test_a_partial_download_is_evaluated_and_its_report_has_pictures(
    da_partial: DeepAccident,
    tmp_path: Path,
    task: str,
    protocol: str,
    write: Callable[..., Path],
    line: str,
) -> None:
    """The truth of the present agents is a perfect prediction.

    The released protocol's AP of a perfect prediction is 97.22 %.
    """
    tokens = da_partial.evaluation_samples("val", "paper", scope="all")
    agents = set(taxonomy.AGENTS) - {"other_vehicle_behind"}
    assert {token.split("/")[2] for token in tokens} == agents
    results = write(da_partial, tmp_path / "results", tokens)
    words = (task, da_partial.dataroot, "--results", results, "--split", "val")
    options = ("--protocol", protocol, *ALL_LABELLED_SAMPLES, "--sanity")

    text = evaluate(*words, *options, "--out", tmp_path / "bundle").stdout

    assert "samples      8 from 2 scenarios: split val" in text
    assert f" {line} " in " ".join(text.split())
    report = read_report(tmp_path / "bundle" / "report.html")
    assert len(report.all("img")) >= 2
    assert line.split(maxsplit=1)[0] in report.text


def test_a_part_is_refused_unless_allowed_and_marked_everywhere(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    results = write_accidents(da_motion, tmp_path / "some.json", tokens[3:])
    out = tmp_path / "bundle"
    options = (*SPLIT_AND_AGENTS, "--protocol", "boxes", "--out", out)
    words = ("accident", da_motion.dataroot, "--results", results, *options)
    message = ("without a prediction: 3 of 8 samples", "--allow-partial")
    assert_raises((lambda: evaluate(*words), ResultsError, message))
    assert not list(tmp_path.glob("bundle*"))

    text = evaluate(*words, "--allow-partial", "--sanity").stdout
    titles = [block.splitlines()[0] for block in text.split("\n\n")]
    assert [title for title in titles if "PARTIAL: 5 of 8 samples" not in title] == []
    assert len(titles) > 4
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "PARTIAL: 5 of 8 samples" in report


class TestVerify:
    def test_the_same_numbers_are_found_again(self, bundle: Path, da_motion: DeepAccident) -> None:
        process = run_command(
            "check", "bundle", bundle, "--dataroot", da_motion.dataroot, "--on-error", "skip"
        )
        assert "identical: 8 samples evaluated again" in process.stdout

    def test_the_message_repeats_the_paths_of_a_bundle(
        self, bundle: Path, da_motion: DeepAccident
    ) -> None:
        message = run_command("check", "bundle", bundle, status=2).stderr
        command = (
            f"deepaccident check bundle {shlex.quote(str(bundle))} --dataroot "
            f"{da_motion.dataroot}\n"
        )
        assert message.count("\n") == 1
        assert message.endswith(command)

    def test_nothing_is_written_into_the_release(
        self, bundle: Path, da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        release, cache = tmp_path / "release", tmp_path / "cache"
        shutil.copytree(da_motion.dataroot, release, ignore=shutil.ignore_patterns(".deepaccident"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        command = ("check", "bundle", bundle, "--dataroot", release)

        paths = sorted(release.rglob("*"))
        invoke_command(*command)
        assert sorted(release.rglob("*")) == paths
        assert list(cache.rglob("manifest.json"))

        shutil.rmtree(cache)
        invoke_command(*command, "--index-dir", tmp_path / "index")
        DeepAccident(dataroot=release, verbose=False)
        invoke_command(*command)
        assert not cache.exists()


@pytest.fixture(scope="module")
def two_bundles(da_motion: DeepAccident, folder: Path) -> list[Path]:
    """Two evaluations of two scenarios each; the second is worse."""
    bundles = []
    selection = SampleSelection(split="train", scope="all", agents=AGENTS)
    setup = EvaluationSetup(task="accident", protocol="boxes")
    tokens = selection.tokens(da_motion)
    for name, moved in (("a", 0.1), ("b", 1.0)):
        results = write_accidents(da_motion, folder / f"{name}.json", tokens, moved)
        run = evaluate_results(da_motion, results, setup, selection, workers=1)
        bundles.append(save_run(run, folder / name))
    return bundles


class TestCompare:
    def test_text_and_files(self, two_bundles: list[Path], tmp_path: Path) -> None:
        table, numbers, figure = paths = [
            tmp_path / name for name in ("numbers.csv", "numbers.json", "differences.svg")
        ]
        words = ("compare", *two_bundles, "--resamples", 20)

        outs = [word for path in paths for word in ("--out", path)]
        text = evaluate(*words, *outs).output

        # an interval needs more than one cluster
        row = next(line.split() for line in text.splitlines() if line.startswith("position error"))
        assert row[3:6] == ["0.283", "2.828", "+2.546"]
        assert row[-2:] == ["too", "few"]
        assert "\n".join(f"wrote {path}" for path in paths) in text
        content = json.loads(numbers.read_text())
        assert content == json.loads(evaluate(*words, "--json").stdout)
        assert table.read_text().count("\n") == len(content["numbers"]) + 1
        assert "<svg" in figure.read_text()


class TestCheck:
    def test_the_output_names_task_and_file(self, results: dict[str, Path]) -> None:
        for kind, task in (("motion", "motion"), ("accidents", "accident"), ("boxes", "detection")):
            output = invoke_command("check", "results", results[kind]).stdout
            assert output.startswith(f"results      {task}, {results[kind]}\n")

    def test_against_a_release(self, da_motion: DeepAccident, results: dict[str, Path]) -> None:
        release = ("--dataroot", da_motion.dataroot, "--split", "train")
        words = ("check", "results", results["motion"], *release)

        output = invoke_command(*words, "--agents", ",".join(AGENTS)).stdout
        assert (
            "all 8 samples have a prediction, and no others do\nSanity check of 8 samples: "
            in output
        )
        assert "No mistake found. Checked: x mirrored, " in output

        output = invoke_command(*words, status=1).stdout
        assert "the predictions were made with --agents " in output

    def test_results_of_other_samples_are_not_compared(
        self, da_motion: DeepAccident, results: dict[str, Path]
    ) -> None:
        release = ("--dataroot", da_motion.dataroot, "--split", "train")
        words = ("check", "results", results["motion"], *release, "--agents", "other_vehicle")
        with pytest.raises(EvaluationError, match="no sample to compare"):
            invoke_command(*words)

    def test_repeats_the_warnings_of_the_sanity_check(
        self, da_motion: DeepAccident, tmp_path: Path, tokens: list[str]
    ) -> None:
        results = tmp_path / "empty.json"
        with ResultsWriter(results, "accident") as writer:
            for token in tokens:
                writer.add(token, [])

        words = ("accident", da_motion.dataroot, "--results", results, *SPLIT_AND_AGENTS)
        output = evaluate(*words, "--protocol", "boxes", "--sanity", status=2).stdout
        warnings = output.splitlines()[-3:]
        assert warnings[0].startswith("Sanity check of 8 samples: 0 of 0 accidents")
        assert "examined predictions are empty" in warnings[1]
        assert warnings[2].startswith("No verdict: ")

        release = ("--dataroot", da_motion.dataroot, *SPLIT_AND_AGENTS[:-2])
        output = invoke_command("check", "results", results, *release, status=2).stdout
        assert output.splitlines()[-3:] == warnings


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ("--switch gap=3", ChoiceError, ("these rules have no switch 'gap'",)),
        (
            "--switch reading.danger_distance=high",
            ChoiceError,
            ("danger_distance", "a number, such as 1.0, found 'high'"),
        ),
        ("--split nowhere", ChoiceError, ("split: expected one of train, val",)),
        (
            "--agents ego",
            ChoiceError,
            ("--agents: expected one of ego_vehicle", "did you mean 'ego_vehicle'"),
        ),
        (
            "--switch reading.danger_distance",
            None,
            ("--switch: expected NAME=VALUE, found 'reading.danger_distance'",),
        ),
        ("--by wether", None, ("Invalid value for '--by'",)),
        ("--protocol boxy", None, ("Invalid value for '--protocol'",)),
        ("--out {}", ResultsError, ("is not empty and contains no evaluation",)),
    ],
)
def test_options_that_are_refused(
    words: tuple[object, ...],
    tmp_path: Path,
    options: str,
    error: type[Exception] | None,
    message: tuple[str, ...],
) -> None:
    (tmp_path / "thesis.tex").touch()
    command = (*words, *options.format(tmp_path).split())
    if error:
        assert_raises((lambda: evaluate(*command), error, message))
    else:
        assert message[0] in evaluate(*command, status=2).output


def test_an_operating_point_from_another_split(
    da_motion: DeepAccident, results: dict[str, Path], bundle: Path, folder: Path
) -> None:
    """The release has only one pair of twins.

    After its recordings are renamed, its evaluation stands for one of another split.
    """
    out = folder / "chooses"
    samples = (*SPLIT_AND_AGENTS, "--samples", "evaluate", "--scope", "accident")
    words = ("warning", da_motion.dataroot, "--results", results["accidents"], *samples)
    evaluate(*words, "--out", out)
    same_recordings = (
        "or its twin, and a threshold chosen on the evaluated recordings gives numbers that are",
    )
    other_task = ("is an evaluation of accident boxes; expected one of warning, protocol",)
    assert_raises(
        (lambda: evaluate(*words, "--threshold-from", out), EvaluationError, same_recordings),
        (lambda: evaluate(*words, "--threshold-from", bundle), EvaluationError, other_task),
    )

    result = evaluate(*words, "--threshold-from", rename_recordings(out), "--json")

    summary = read_summary(result)
    stored = json.loads((out / "metrics_summary.json").read_text())
    threshold = stored["metrics"]["groups"]["ego_involved"]["best_f1"]
    assert summary["switches"] == {"threshold": threshold}
    assert summary["metrics"]["operating_by"] == "given"


@pytest.fixture(scope="module")
def prevention(da_motion: DeepAccident, folder: Path) -> Path:
    """An evaluation of the true accidents over whole recordings.

    It includes the accidents that these predictions would have prevented.
    """
    tokens = [token for token in da_motion.samples("train", "all") if token.split("/")[2] in AGENTS]
    results = write_accidents(da_motion, folder / "whole.json", tokens)
    words = ("warning", da_motion.dataroot, "--results", results, *SPLIT_AND_AGENTS)
    options = ("--prevented", "--include-results", "--out", folder / "prevention")
    text = evaluate(*words, *options).output
    assert "\nprevented accidents\n  ego involved in the accident, 1 s, 6 m/s²" in text
    assert "for another split: braking " in text
    return folder / "prevention"


def test_prevented_accidents_are_stored_shown_and_verified(
    prevention: Path, da_motion: DeepAccident
) -> None:
    prevented = read_bundle(prevention).summary["prevented"]
    assert list(prevented["groups"]) == ["ego_involved", "infrastructure"]
    always_braking = prevented["references"]["always"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    predictions = prevented["groups"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    assert always_braking["shares"]["avoided"] >= predictions["shares"]["avoided"]
    assert always_braking["braking_seconds_per_minute"] > 0
    assert predictions["braking_seconds_per_minute"] == 0
    report = read_report(prevention / "report.html").text
    assert "Prevented accidents" in report
    assert "random per frame, ≤ 1 s/min" in report
    assert (prevention / "figures" / "prevention_ego_involved.png").is_file()

    words = ("check", "bundle", prevention, "--dataroot", da_motion.dataroot)
    assert "identical: " in invoke_command(*words).output
    for message, change in {
        "prevented/groups/ego_involved/quiet_braking: stored 0.5, found 1.0": lambda text: (
            text.replace('"quiet_braking": 1.0', '"quiet_braking": 0.5')
        ),
        "does not say how intervals were made": lambda text: json.dumps(
            json.loads(text) | {"prevented": {"groups": {}}}
        ),
    }.items():
        with change_text(prevention / "metrics_summary.json", change):
            assert message in invoke_command(*words, status=1).output
            comparison = json.loads(invoke_command(*words, "--json", status=1).stdout)
            assert comparison["differences"]


def test_a_threshold_of_little_braking_from_another_split(
    prevention: Path, da_motion: DeepAccident, folder: Path, tmp_path: Path
) -> None:
    other = rename_recordings(shutil.copytree(prevention, tmp_path / "other"))
    threshold = ("--threshold-from", other, "--threshold-by", "braking")
    options = (*SPLIT_AND_AGENTS, *threshold, "--prevented", "--json")
    words = ("warning", da_motion.dataroot, "--results", folder / "whole.json", *options)

    summary = read_summary(evaluate(*words))

    assert summary["switches"] == {"threshold": 1.0}
    assert summary["prevented"]["operating_by"] == "given"
    assert not any("on these very recordings" in note for note in summary["prevented"]["notes"])

    path = other / "metrics_summary.json"
    stored = json.loads(path.read_text())
    del stored["prevented"]
    path.write_text(json.dumps(stored))
    message = ("its summary has no prevented accidents", "--prevented")
    assert_raises((lambda: evaluate(*words), ResultsError, message))
