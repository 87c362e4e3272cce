"""Bundles made again: the same, or every difference named."""

import json
import os
import shutil
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
from evaluation_runs import stored_run
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    Verification,
    compare_bundles,
    default_selection,
    evaluate_results,
    save_run,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.rows import read_rows, write_rows
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.runs.verification import ABSENT_TEXT, find_differences
from deepaccident_devkit.support.reading import file_checksum

pytestmark = pytest.mark.slow

Write = Callable[..., Results]
SUMMARY_CHANGED = "files.json: metrics_summary.json"


@pytest.fixture
def bundle(run: EvaluationRun, tmp_path: Path) -> Path:
    return save_run(
        run.broken_down(["all", "agent"], Resampling(resamples=10)), tmp_path / "bundle"
    )


def verify(bundle: Path, dataset: DeepAccident, **named: Any) -> Verification:
    """With the results beside the bundle, unless others are given, or a copy is in it."""
    beside = None if (bundle / "results").exists() else bundle.with_name("accidents.json")
    return verify_bundle(bundle, dataset, workers=1, **{"results": beside, **named})


def changed(path: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def found(verification: Verification) -> list[str]:
    return [each.where for each in verification.differences]


def test_nothing_differs(bundle: Path, da_b: DeepAccident) -> None:
    verification = verify(bundle, da_b)
    assert (verification.is_same, verification.samples, verification.notes) == (True, 6, ())
    assert verification.to_dict()["same"] is True


@pytest.mark.parametrize(
    ("task", "protocol"),
    [
        ("motion", "paper"),
        ("accident", "boxes"),
        ("detection", "opencood"),
        ("warning", "clean"),
        ("warning", "field"),
        ("planning", "clean"),
        ("planning", "uniad"),
        ("forecasting", "clean"),
    ],
)
def test_nothing_differs_whatever_the_task(
    da_b: DeepAccident, tmp_path: Path, task: str, protocol: str
) -> None:
    """With groups, another horizon, and numbers that only some samples have."""
    setup = EvaluationSetup(task=task, protocol=protocol, horizon=0.5)
    selection = default_selection(setup, "val", agents=("ego_vehicle",), scope="all")
    run, results = stored_run(da_b, setup, tmp_path / "results", selection)
    bundle = save_run(
        run.broken_down(("all", "agent"), Resampling(resamples=10)), tmp_path / "bundle"
    )
    verification = verify(bundle, da_b, results=results)
    assert (verification.is_same, verification.differences) == (True, ())


def test_with_results_inside_and_elsewhere(
    run: EvaluationRun, tmp_path: Path, own_release: Path
) -> None:
    bundle = save_run(run, tmp_path / "bundle", include_results=True)
    moved = tmp_path / "moved"
    shutil.move(bundle, moved)
    (tmp_path / "accidents.json").unlink()
    assert verify(moved, DeepAccident(dataroot=own_release, verbose=False)).is_same


def test_a_partial_one(
    da_b: DeepAccident,
    selection: SampleSelection,
    tmp_path: Path,
    write_accidents: Write,
    run: EvaluationRun,
) -> None:
    results = write_accidents(tmp_path / "some.json", selection.tokens(da_b)[1:])
    part = evaluate_results(da_b, results, run.setup, selection, allow_partial=True, workers=1)
    assert verify(save_run(part, tmp_path / "bundle"), da_b, results=results).is_same


@pytest.mark.parametrize(
    ("place", "stored", "named"),
    [
        ("metrics/apa", 0.99, ["metrics/apa"]),
        ("breakdowns/all/groups/0/metrics/apa", 1 - 1e-16, ["breakdowns/all/groups/0/metrics/apa"]),
        ("devkit_version", "0.0.9", ["devkit_version"]),
        ("environment/numpy", "1.0", []),
    ],
)
def test_a_value_of_the_summary(
    bundle: Path, da_b: DeepAccident, place: str, stored: object, named: list[str]
) -> None:
    """To the last bit; another numpy is a note."""

    def change(summary: Any) -> None:
        *parts, last = place.split("/")
        reduce(lambda at, part: at[int(part) if part.isdigit() else part], parts, summary)[last] = (
            stored
        )

    changed(bundle / "metrics_summary.json", change)
    verification = verify(bundle, da_b)
    assert found(verification) == [
        SUMMARY_CHANGED,
        *(f"metrics_summary.json: {each}" for each in named),
    ]
    assert any(
        "evaluated with numpy 1.0, verified with " in note for note in verification.notes
    ) != bool(named)
    assert verification.samples == 6


@pytest.mark.parametrize("kind", ["label", "meta", "calib"])
def test_a_file_of_a_scenario(bundle: Path, own_release: Path, kind: str) -> None:
    """Also before the index knows of it: then there are no numbers of the files that are there."""
    opened = DeepAccident(dataroot=own_release, verbose=False)
    path = min(
        own_release.glob("val/*/meta/*.txt" if kind == "meta" else f"val/*/ego_vehicle/{kind}/*/*")
    )
    path.write_bytes(path.read_bytes() + b"\n")
    token, verification = min(opened.split_scenarios("val")), verify(bundle, opened)
    assert found(verification) == ["all numbers"]
    assert "the index is out of date" in verification.notes[0]
    verification = verify(
        bundle, DeepAccident(dataroot=own_release, index_dir=own_release / "anew", verbose=False)
    )
    assert found(verification) == [
        "metrics_summary.json: release/fingerprint",
        f"scenarios.json: {token}/{kind}",
    ]


def one_more_point(release: Path) -> None:
    """As on another processor, in a box of another class than the agent's own row."""
    path = min(release.glob("val/*/ego_vehicle/label/*/*_001.txt"))
    lines = path.read_text().split("\n")
    words = lines[-1].split(" ")
    lines[-1] = " ".join([*words[:11], str(int(words[11]) + 1), words[12]])
    path.write_text("\n".join(lines))


def without_boxes(bundle: Path) -> None:
    """Make it a bundle of devkit 1.0.0, which kept the hashes of whole files only."""
    path = bundle / "scenarios.json"
    changed(
        path,
        lambda stored: [
            each.pop(name) for each in stored["scenarios"].values() for name in ("boxes", "points")
        ],
    )
    changed(
        bundle / "files.json",
        lambda listed: listed["files"].update({path.name: file_checksum(path)}),
    )


def test_labels_with_a_few_other_points_are_the_same(
    bundle: Path,
    own_release: Path,
    results: Results,
    run: EvaluationRun,
    selection: SampleSelection,
) -> None:
    one_more_point(own_release)
    opened = DeepAccident(dataroot=own_release, verbose=False)
    assert verify(bundle, opened).is_same
    again = evaluate_results(opened, results, run.setup, selection, workers=1)
    other = save_run(again, bundle.with_name("other"))
    assert compare_bundles(bundle, other, Resampling(resamples=10)).samples == 6
    without_boxes(bundle)
    token = min(opened.split_scenarios("val"))
    assert found(verify(bundle, opened)) == [
        "metrics_summary.json: release/fingerprint",
        f"scenarios.json: {token}/label",
    ]
    with pytest.raises(EvaluationError, match="files of 1 scenarios are not the same"):
        compare_bundles(bundle, other)


def test_a_bundle_of_devkit_1_0_0_verifies_and_compares(
    bundle: Path, da_b: DeepAccident, run: EvaluationRun
) -> None:
    new = save_run(run, bundle.with_name("new"))
    without_boxes(bundle)
    assert verify(bundle, da_b).is_same
    assert compare_bundles(bundle, new, Resampling(resamples=10)).samples == 6


def test_a_scenario_that_is_gone(bundle: Path, own_release: Path) -> None:
    for folder in own_release.glob("val/*_normal"):
        shutil.rmtree(folder)
    verification = verify(bundle, DeepAccident(dataroot=own_release, verbose=False))
    assert found(verification) == ["all numbers"]
    assert "3 predictions of no sample of this release" in verification.notes[0]
    assert verification.samples == 0


def test_a_scenario_that_the_bundle_does_not_state(bundle: Path, da_b: DeepAccident) -> None:
    gone = min(read_scenarios(bundle, "_normal"))
    changed(bundle / "scenarios.json", lambda stored: stored["scenarios"].pop(gone))
    assert found(verify(bundle, da_b)) == ["files.json: scenarios.json", f"scenarios.json: {gone}"]


def test_other_results(
    bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path, write_accidents: Write
) -> None:
    differing = found(
        verify(
            bundle,
            da_b,
            results=write_accidents(tmp_path / "other.json", results.tokens, moved=1.0).path,
        )
    )
    assert {each.split(": ")[0] for each in differing} == {
        "metrics_summary.json",
        "counts.json",
        "samples.parquet",
    }
    assert "metrics_summary.json: results/fingerprint" in differing


def test_counts_of_a_sample(bundle: Path, da_b: DeepAccident) -> None:
    token = min(json.loads((bundle / "counts.json").read_text())["counts"])
    changed(bundle / "counts.json", lambda state: state["counts"][token].update(unjudged=7))
    assert found(verify(bundle, da_b)) == [
        "files.json: counts.json",
        f"counts.json: {token}/unjudged",
    ]


def test_a_row(bundle: Path, da_b: DeepAccident) -> None:
    rows, stamp = read_rows(bundle / "samples.parquet")
    rows[2]["tp_10m"] = 5
    write_rows(bundle / "samples.parquet", rows[:-1], stamp)
    assert found(verify(bundle, da_b)) == [
        "files.json: samples.parquet",
        f"samples.parquet: {rows[2]['token']}/tp_10m",
        f"samples.parquet: {rows[-1]['token']}",
    ]


def test_files_foreign_missing_and_damaged(bundle: Path, da_b: DeepAccident) -> None:
    (bundle / "mine.txt").touch()
    (bundle / "counts.json").unlink()
    (bundle / "samples.parquet").write_bytes(b"PAR1")
    (bundle / "scenarios.json").write_text("{}")
    verification = verify(bundle, da_b)
    assert found(verification) == [
        *("files.json: counts.json", "files.json: samples.parquet", "files.json: scenarios.json"),
        *("files.json: mine.txt", "scenarios.json", "counts.json", "samples.parquet"),
    ]
    (bundle / "files.json").write_text("")
    assert found(verify(bundle, da_b))[0] == "files.json"


def test_another_protocol_claimed(bundle: Path, da_b: DeepAccident) -> None:
    """With a smaller danger distance the pairs that pass close by in the normal scenario are no
    accidents.
    """
    changed(
        bundle / "metrics_summary.json",
        lambda summary: summary.update(switches={"reading.danger_distance": 0.5}),
    )
    normal = [
        token
        for token in json.loads((bundle / "counts.json").read_text())["counts"]
        if "_normal" in token
    ]
    differing = found(verify(bundle, da_b))
    assert differing[:2] == [
        SUMMARY_CHANGED,
        "metrics_summary.json: settings/choices/reading/danger_distance",
    ]
    assert {f"counts.json: {token}/named" for token in normal} < set(differing)


def read_scenarios(bundle: Path, ending: str) -> list[str]:
    return [
        token
        for token in json.loads((bundle / "scenarios.json").read_text())["scenarios"]
        if f"{ending}/" in token
    ]


@pytest.mark.parametrize(
    ("stored", "found", "expected"),
    [
        ({"a": 1, "b": [1, 2]}, {"b": [1, 2], "a": 1}, []),
        ({"a": 1}, {"a": 1.0}, [("a", 1, 1.0)]),
        ({"a": True}, {"a": 1}, [("a", True, 1)]),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, [("a/b/1", 2, 3)]),
        ({"a": [1]}, {"a": [1, 2]}, [("a", [1], [1, 2])]),
        ({"a": 1}, {"b": 1}, [("a", 1, ABSENT_TEXT), ("b", ABSENT_TEXT, 1)]),
        ({"a": None}, {}, [("a", None, ABSENT_TEXT)]),
        ({"skip": 1, "keep": {"skip": 1}}, {"skip": 2, "keep": {"skip": 2}}, [("keep/skip", 1, 2)]),
    ],
)
def test_differing(stored: Any, found: Any, expected: list[tuple[str, Any, Any]]) -> None:
    assert list(find_differences(stored, found, without=["skip"])) == expected


def test_what_does_not_belong_is_named_and_not_opened(
    bundle: Path, da_b: DeepAccident, tmp_path: Path
) -> None:
    os.mkfifo(bundle / "a pipe")
    (bundle / "loop").symlink_to("loop")
    (bundle / "a link").symlink_to(tmp_path)
    (bundle / "extra\x1b.bin").write_bytes(b"1")
    (bundle / "scenarios.json").rename(tmp_path / "scenarios.json")
    (bundle / "scenarios.json").symlink_to(tmp_path / "scenarios.json")
    with (bundle / "counts.json").open("r+b") as file:
        file.truncate(5 << 30)
    verification = verify(bundle, da_b)
    named = {each.where: each.found for each in verification.differences}
    assert named["files.json: a pipe"] == "not a regular file (a named pipe)"
    assert named["files.json: loop"] == named["files.json: a link"] == "a link"
    assert named["files.json: extra\x1b.bin"] == "a file that is not listed"
    assert "is a link, which is not followed" in named["scenarios.json"]
    assert "has 5,368,709,120 bytes" in named["counts.json"]
    assert "\x1b" not in verification.to_text()


@pytest.mark.parametrize(
    "name",
    ["metrics_summary.json", "files.json", "scenarios.json", "counts.json", "samples.parquet"],
)
def test_a_pipe_in_the_place_of_a_file(bundle: Path, da_b: DeepAccident, name: str) -> None:
    (bundle / name).unlink()
    os.mkfifo(bundle / name)
    if name == "metrics_summary.json":
        assert_refused(
            (
                lambda: verify(bundle, da_b),
                ResultsError,
                r"metrics_summary.json: not a regular file \(a named pipe\)",
            ),
        )
    else:
        assert name in found(verify(bundle, da_b))


def test_paths_that_lead_out_are_opened_only_if_they_are_given(
    bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path
) -> None:
    command = f"check bundle {bundle} --dataroot {da_b.dataroot} --results {results.path}"
    assert_refused(
        (
            lambda: verify(bundle, da_b, results=None),
            ResultsError,
            f"are opened only if you give them: deepaccident {command}$",
        ),
    )
    splits = tmp_path / "mine.txt"
    os.mkfifo(splits)
    changed(bundle / "metrics_summary.json", lambda summary: summary.update(split=str(splits)))
    assert_refused(
        (lambda: verify(bundle, da_b), ResultsError, f"{command} --split {splits}$"),
    )
    splits.unlink()
    scenarios = sorted({token.rsplit("/", 2)[0] for token in results.tokens})
    splits.write_text("".join(f"{token.replace('/', ' ')}\n" for token in scenarios))
    assert found(verify(bundle, da_b, split=splits)) == [SUMMARY_CHANGED]


@pytest.mark.parametrize("kind", ["the folder", "the file", "a loop", "a pipe"])
def test_a_copy_of_the_results_that_leads_out_is_refused(
    run: EvaluationRun, da_b: DeepAccident, tmp_path: Path, kind: str
) -> None:
    bundle = save_run(run, tmp_path / "bundle", include_results=True)
    copy = bundle / "results" / "accidents.json"
    if kind == "the folder":
        (bundle / "results").rename(tmp_path / "moved")
        (bundle / "results").symlink_to(tmp_path / "moved")
    else:
        copy.rename(tmp_path / "elsewhere.json")
        copy.symlink_to({"the file": tmp_path / "elsewhere.json"}.get(kind, copy))
    if kind == "a pipe":
        copy.unlink()
        os.mkfifo(copy)
    assert_refused(
        (
            lambda: verify(bundle, da_b),
            ResultsError,
            r"bundle: results(/accidents.json)? is (a link|not a regular file)",
        ),
    )


@pytest.mark.parametrize(
    "resampling",
    [
        {"resamples": 10**9},
        {"resamples": "9"},
        {"seed": -1},
        {"seed": []},
        {"confidence": "x"},
        {"depth": 1},
        {"seed": 0.5},
    ],
)
def test_counts_of_resamples_are_bounded(
    bundle: Path, da_b: DeepAccident, resampling: dict[str, Any]
) -> None:
    changed(
        bundle / "metrics_summary.json",
        lambda summary: summary["breakdowns"]["all"].update(resampling=resampling),
    )
    assert "all numbers" in found(verify(bundle, da_b))


def test_no_results(bundle: Path, da_b: DeepAccident, results: Results) -> None:
    results.path.unlink()
    assert_refused(
        (lambda: verify(bundle, da_b), ResultsError, ("accidents.json", "no such file or folder"))
    )


def test_hashes_of_a_stranger_are_text(bundle: Path, da_b: DeepAccident) -> None:
    token = min(json.loads((bundle / "scenarios.json").read_text())["scenarios"])
    for points in ([10**400] * 8, [1], [None] * 8):
        changed(
            bundle / "scenarios.json",
            lambda stored, points=points: stored["scenarios"][token].update(
                label="\u202e", points=points
            ),
        )
        text = verify(bundle, da_b).to_text()
        assert "scenarios.json" in text
        assert "\u202e" not in text
