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
from refusals import assert_refused
from report_page import page_of
from verbs import called, ran

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

pytestmark = pytest.mark.slow

AGENTS = ("ego_vehicle", "infrastructure")
LISTED = ("--samples", "evaluate", "--scope", "all", "--resamples", "0")
LIST = ("--split", "train", "--agents", ",".join(AGENTS), "--resamples", "0")


evaluate, run = (partial(each, "evaluate") for each in (called, ran))


def summary_of(result: Result) -> Any:
    """The JSON that a verb prints, after what it tells before."""
    return json.loads(result.output[result.output.index("{") :])


def renamed(bundle: Path) -> Path:
    """An evaluation, as if it were of other recordings than those it is of."""
    stored = json.loads((bundle / "scenarios.json").read_text())
    others = {
        name.replace("_type001_", "_type009_"): each for name, each in stored["scenarios"].items()
    }
    (bundle / "scenarios.json").write_text(json.dumps(stored | {"scenarios": others}))
    return bundle


@contextmanager
def changed(path: Path, change: Callable[[str], str]) -> Iterator[None]:
    """A text file that is another one for a time."""
    before = path.read_text()
    path.write_text(change(before))
    try:
        yield
    finally:
        path.write_text(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for what several tests read; with a blank in its name."""
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
            true = None if truth is None else truth.accident
            alarms = (
                []
                if true is None
                else [Accident(positions=true.positions + moved, time=true.time, ids=true.ids)]
            )
            writer.add(token, alarms)
    return path


def write_motion(dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: int = 0) -> Path:
    with ResultsWriter(path, "motion", meta={"method": "<b>moved</b>"}) as writer:
        for token in tokens:
            label = dataset.motion_labels(token).to_present("bilinear")
            writer.add(
                token, instances_of(np.roll(label.instance, moved, axis=2), label.config.grid)
            )
    return path


def write_boxes(dataset: DeepAccident, path: Path, tokens: Iterable[str]) -> Path:
    with ResultsWriter(path, "detection") as writer:
        for token in tokens:
            there = dataset.boxes(token)
            writer.add(token, DetectedBoxes(boxes=there, scores=np.linspace(0.1, 1, len(there))))
    return path


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, folder: Path, tokens: list[str]) -> dict[str, Path]:
    """The true accidents, moved a little; the labels as predictions, moved by a column; the true
    boxes.
    """
    return {
        "accidents": write_accidents(da_motion, folder / "accidents.json", tokens),
        "motion": write_motion(da_motion, folder / "motion", tokens, moved=1),
        "boxes": write_boxes(da_motion, folder / "boxes.json", tokens),
    }


@pytest.fixture(scope="module")
def words(da_motion: DeepAccident, results: dict[str, Path]) -> tuple[object, ...]:
    """Those of an evaluation of the accidents."""
    return (
        "accident",
        da_motion.dataroot,
        "--results",
        results["accidents"],
        *LIST,
        "--protocol",
        "boxes",
    )


@pytest.fixture(scope="module")
def bundle(words: tuple[object, ...], folder: Path) -> Path:
    """An evaluation with all that there is."""
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
    words = (task, da_motion.dataroot, "--results", results[kind], *LIST, "--protocol", protocol)
    text = evaluate(*words, "--samples", "evaluate", "--scope", "accident").output
    told = (
        f"{task}, protocol {protocol}",
        "samples      8 of 1 scenarios: split train",
        f"\n  {headline} ",
    )
    assert [each for each in told if each not in text] == []
    assert "PARTIAL" not in text


def test_a_bundle_with_all_there_is(
    bundle: Path, results: dict[str, Path], da_motion: DeepAccident
) -> None:
    assert {path.name for path in bundle.iterdir()} == {
        *("metrics_summary.json", "counts.json", "samples.parquet", "scenarios.json", "files.json"),
        *("report.html", "figures", "results"),
    }
    summary = read_bundle(bundle).summary
    assert (summary["sanity"]["samples"], summary["release"]["dataroot"]) == (
        8,
        str(da_motion.dataroot),
    )
    assert (bundle / "results" / "accidents.json").read_bytes() == results["accidents"].read_bytes()
    assert not bundle.with_name("bundle.unfinished").exists()


def test_several_processes_write_one_evaluation(
    words: tuple[object, ...], bundle: Path, tmp_path: Path
) -> None:
    more = ("--sanity", "--include-results", "--out", tmp_path / "out")
    line = [sys.executable, "-m", "deepaccident_devkit.cli", "evaluate", *map(str, (*words, *more))]
    running = [
        subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    told = [process.communicate(timeout=300) for process in running]
    if all(process.returncode == 0 for process in running):  # else one began when all was done
        assert all("samples      8 of 1 scenarios: split train" in printed for printed, _ in told)
    else:
        assert any("holds an evaluation; pass overwrite=True" in errors for _, errors in told), told
    names = [path.relative_to(bundle) for path in bundle.rglob("*") if path.is_file()]
    assert [
        name
        for name in names
        if (tmp_path / "out" / name).read_bytes() != (bundle / name).read_bytes()
    ] == []
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


def test_json_is_the_summary(words: tuple[object, ...], tmp_path: Path) -> None:
    options = (
        "--by",
        "town",
        "--switch",
        "reading.danger_distance=0.5",
        "--json",
        "--out",
        tmp_path / "b",
    )
    done = evaluate(*words, *options)
    summary = json.loads(done.stdout)
    assert summary == read_bundle(tmp_path / "b").summary
    told = (["all", "town"], {"reading.danger_distance": 0.5}, True)
    assert (
        [*summary["breakdowns"]],
        summary["switches"],
        f"written: {tmp_path / 'b'}" in done.stderr,
    ) == told


@pytest.mark.parametrize(
    ("task", "protocol", "write", "line"),
    [
        ("motion", "released", write_motion, "iou 100x100 100.00 %"),
        ("accident", "boxes", write_accidents, "apa 1.000"),
        ("detection", "released", write_boxes, "AP car 97.22 %"),
        ("warning", "clean", write_accidents, "recall ego_involved 1.000"),
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
    """The truth of the agents that are there is a perfect prediction (the released AP is 97.22 %,
    then).
    """
    tokens = da_partial.evaluation_samples("val", "paper", scope="all")
    assert {token.split("/")[2] for token in tokens} == set(taxonomy.AGENTS) - {
        "other_vehicle_behind"
    }
    results = write(da_partial, tmp_path / "results", tokens)
    words = (
        task,
        da_partial.dataroot,
        "--results",
        results,
        "--split",
        "val",
        "--protocol",
        protocol,
    )
    text = evaluate(*words, *LISTED, "--sanity", "--out", tmp_path / "bundle").stdout
    assert "samples      8 of 2 scenarios: split val" in text
    assert f" {line} " in " ".join(text.split())
    report = page_of(tmp_path / "bundle" / "report.html")
    assert len(report.all("img")) >= 2
    assert line.split(maxsplit=1)[0] in report.text


def test_a_part_is_refused_unless_allowed_and_marked_everywhere(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    some = write_accidents(da_motion, tmp_path / "some.json", tokens[3:])
    words = ("accident", da_motion.dataroot, "--results", some, *LIST, "--protocol", "boxes")
    told = ("without a prediction: 3 of 8 samples", "--allow-partial")
    assert_refused((lambda: evaluate(*words, "--out", tmp_path / "bundle"), ResultsError, told))
    assert not list(tmp_path.glob("bundle*"))
    text = evaluate(*words, "--allow-partial", "--sanity", "--out", tmp_path / "bundle").stdout
    titles = [block.splitlines()[0] for block in text.split("\n\n")]
    assert [title for title in titles if "PARTIAL: 5 of 8 samples" not in title] == []
    assert len(titles) > 4
    assert "PARTIAL: 5 of 8 samples" in (tmp_path / "bundle" / "report.html").read_text(
        encoding="utf-8"
    )


class TestVerify:
    def test_the_same(self, bundle: Path, da_motion: DeepAccident) -> None:
        done = ran(
            "check", "bundle", bundle, "--dataroot", da_motion.dataroot, "--on-error", "skip"
        )
        assert "the same; 8 samples evaluated again" in done.stdout

    def test_paths_in_a_bundle_are_to_be_repeated(
        self, bundle: Path, da_motion: DeepAccident
    ) -> None:
        told = ran("check", "bundle", bundle, status=2).stderr
        command = (
            f"deepaccident check bundle {shlex.quote(str(bundle))} --dataroot "
            f"{da_motion.dataroot}\n"
        )
        assert (told.count("\n"), told.endswith(command)) == (1, True)

    def test_nothing_is_written_into_the_release(
        self, bundle: Path, da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        copied, cache = tmp_path / "release", tmp_path / "cache"
        shutil.copytree(da_motion.dataroot, copied, ignore=shutil.ignore_patterns(".deepaccident"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        before = sorted(copied.rglob("*"))
        called("check", "bundle", bundle, "--dataroot", copied)
        assert sorted(copied.rglob("*")) == before
        assert list(cache.rglob("manifest.json"))
        shutil.rmtree(cache)
        called("check", "bundle", bundle, "--dataroot", copied, "--index-dir", tmp_path / "index")
        DeepAccident(dataroot=copied, verbose=False)
        called("check", "bundle", bundle, "--dataroot", copied)
        assert not cache.exists()


@pytest.fixture(scope="module")
def two(da_motion: DeepAccident, folder: Path) -> list[Path]:
    """Of two scenarios each; the second is worse."""
    made, selection = [], SampleSelection(split="train", scope="all", agents=AGENTS)
    setup = EvaluationSetup(task="accident", protocol="boxes")
    for name, moved in (("a", 0.1), ("b", 1.0)):
        results = write_accidents(
            da_motion, folder / f"{name}.json", selection.tokens(da_motion), moved
        )
        made.append(
            save_run(
                evaluate_results(da_motion, results, setup, selection, workers=1), folder / name
            )
        )
    return made


class TestCompare:
    def test_text_and_files(self, two: list[Path], tmp_path: Path) -> None:
        files = [tmp_path / name for name in ("numbers.csv", "numbers.json", "differences.svg")]
        words = ("compare", *two, "--resamples", 20)
        text = evaluate(*words, *(word for path in files for word in ("--out", path))).output
        # one cluster says nothing of others
        error = next(
            line.split() for line in text.splitlines() if line.startswith("position_error")
        )
        assert (error[2:5], error[-2:]) == (["0.283", "2.828", "+2.546"], ["too", "few"])
        assert "\n".join(f"written: {path}" for path in files) in text
        stated = json.loads(files[1].read_text())
        assert stated == json.loads(evaluate(*words, "--json").stdout)
        assert files[0].read_text().count("\n") == len(stated["numbers"]) + 1
        assert "<svg" in files[2].read_text()


class TestCheck:
    def test_tells_what_it_holds(self, results: dict[str, Path]) -> None:
        for kind, task in (("motion", "motion"), ("accidents", "accident"), ("boxes", "detection")):
            assert called("check", "results", results[kind]).stdout.startswith(
                f"results      {task}, {results[kind]}\n"
            )

    def test_against_a_release(self, da_motion: DeepAccident, results: dict[str, Path]) -> None:
        words = (
            "check",
            "results",
            results["motion"],
            "--dataroot",
            da_motion.dataroot,
            "--split",
            "train",
        )
        good = called(*words, "--agents", ",".join(AGENTS)).stdout
        assert (
            "all 8 samples have a prediction, and nothing else has\nSanity check of 8 samples: "
            in good
        )
        assert "None of these mistakes was found: x mirrored, " in good
        assert "the predictions are of the samples of --agents " in called(*words, status=1).stdout

    def test_of_other_samples_there_is_nothing_to_compare(
        self, da_motion: DeepAccident, results: dict[str, Path]
    ) -> None:
        words = (
            "check",
            "results",
            results["motion"],
            "--dataroot",
            da_motion.dataroot,
            "--split",
            "train",
            "--agents",
        )
        with pytest.raises(EvaluationError, match="no sample to look at"):
            called(*words, "other_vehicle")

    def test_repeats_the_warnings_of_the_sanity_check(
        self, da_motion: DeepAccident, tmp_path: Path, tokens: list[str]
    ) -> None:
        with ResultsWriter(tmp_path / "empty.json", "accident") as writer:
            for token in tokens:
                writer.add(token, [])
        words = (
            da_motion.dataroot,
            "--results",
            tmp_path / "empty.json",
            *LIST,
            "--protocol",
            "boxes",
            "--sanity",
        )
        told = evaluate("accident", *words, status=2).stdout.splitlines()[-3:]
        assert told[0].startswith("Sanity check of 8 samples: 0 of 0 accidents")
        assert "predictions looked at are empty" in told[1]
        assert told[2].startswith("Cannot say whether a mistake was made")
        release = ("--dataroot", da_motion.dataroot, *LIST[:-2])
        assert (
            called(
                "check", "results", tmp_path / "empty.json", *release, status=2
            ).stdout.splitlines()[-3:]
            == told
        )


@pytest.mark.parametrize(
    ("options", "error", "names"),
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
        ("--out {}", ResultsError, ("is not empty and holds no evaluation",)),
    ],
)
def test_options_that_are_refused(
    words: tuple[object, ...],
    tmp_path: Path,
    options: str,
    error: type[Exception] | None,
    names: tuple[str, ...],
) -> None:
    (tmp_path / "thesis.tex").touch()
    given = (*words, *options.format(tmp_path).split())
    if error:
        assert_refused((lambda: evaluate(*given), error, names))
    else:
        assert names[0] in evaluate(*given, status=2).output


def test_an_operating_point_from_another_split(
    da_motion: DeepAccident, results: dict[str, Path], bundle: Path, folder: Path
) -> None:
    """The release has one pair of twins; its evaluation stands for one of others once their names
    are changed.
    """
    out, samples = folder / "chooses", ("--samples", "evaluate", "--scope", "accident")
    words = ("warning", da_motion.dataroot, "--results", results["accidents"], *LIST, *samples)
    evaluate(*words, "--out", out)
    own = ("or its twin, too; a threshold that is chosen on the recordings it is",)
    another = ("is an evaluation of accident boxes; expected one of warning, protocol",)
    assert_refused(
        (lambda: evaluate(*words, "--threshold-from", out), EvaluationError, own),
        (lambda: evaluate(*words, "--threshold-from", bundle), EvaluationError, another),
    )
    summary = summary_of(evaluate(*words, "--threshold-from", renamed(out), "--json"))
    stored = json.loads((out / "metrics_summary.json").read_text())["metrics"]["groups"][
        "ego_involved"
    ]
    assert summary["switches"] == {"threshold": stored["best_f1"]}
    assert summary["metrics"]["operating_by"] == "given"


@pytest.fixture(scope="module")
def prevention(da_motion: DeepAccident, folder: Path) -> Path:
    """An evaluation of the true accidents over whole recordings, with the accidents that they would
    have prevented.
    """
    tokens = [token for token in da_motion.samples("train", "all") if token.split("/")[2] in AGENTS]
    results = write_accidents(da_motion, folder / "whole.json", tokens)
    words = (
        "warning",
        da_motion.dataroot,
        "--results",
        results,
        *LIST,
        "--prevented",
        "--include-results",
    )
    text = evaluate(*words, "--out", folder / "prevention").output
    assert "\nprevented accidents\n  ego_involved, 1 s, 6 m/s²" in text
    assert "for another split: braking " in text
    return folder / "prevention"


def test_prevented_accidents_are_stored_shown_and_verified(
    prevention: Path, da_motion: DeepAccident
) -> None:
    prevented = read_bundle(prevention).summary["prevented"]
    assert list(prevented["groups"]) == ["ego_involved", "infrastructure"]
    siren = prevented["references"]["always"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    given = prevented["groups"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    assert siren["shares"]["avoided"] >= given["shares"]["avoided"]
    assert siren["braking_seconds_per_minute"] > given["braking_seconds_per_minute"] == 0
    report = page_of(prevention / "report.html").text
    assert ("Prevented accidents" in report, "random per frame, quiet" in report) == (True, True)
    assert (prevention / "figures" / "prevention_ego_involved.png").is_file()
    words, path = (
        ("check", "bundle", prevention, "--dataroot", da_motion.dataroot),
        prevention / "metrics_summary.json",
    )
    assert "the same; " in called(*words).output
    for told, change in {
        "prevented/groups/ego_involved/quiet_braking: stored 0.5, found 1.0": lambda text: (
            text.replace('"quiet_braking": 1.0', '"quiet_braking": 0.5')
        ),
        "does not say how intervals were made": lambda text: json.dumps(
            json.loads(text) | {"prevented": {"groups": {}}}
        ),
    }.items():
        with changed(path, change):
            assert told in called(*words, status=1).output
            assert json.loads(called(*words, "--json", status=1).stdout)["differences"]


def test_a_threshold_of_little_braking_from_another_split(
    prevention: Path, da_motion: DeepAccident, folder: Path, tmp_path: Path
) -> None:
    other = renamed(shutil.copytree(prevention, tmp_path / "other"))
    words = (
        "warning",
        da_motion.dataroot,
        "--results",
        folder / "whole.json",
        *LIST,
        "--threshold-from",
        other,
    )
    words = (*words, "--threshold-by", "braking", "--prevented", "--json")
    summary = summary_of(evaluate(*words))
    assert (summary["switches"], summary["prevented"]["operating_by"]) == (
        {"threshold": 1.0},
        "given",
    )
    assert not any("on these very recordings" in note for note in summary["prevented"]["notes"])
    stored = json.loads((other / "metrics_summary.json").read_text())
    del stored["prevented"]
    (other / "metrics_summary.json").write_text(json.dumps(stored))
    told = ("its summary has no prevented accidents", "--prevented")
    assert_refused((lambda: evaluate(*words), ResultsError, told))
