"""Scores that only reproduce a clip's length, a town or a clock are reported; random ones, the
truth and good detectors are not.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.tiny_release import META_TEXT, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError, TokenError
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.plugins.audit import AuditReport, audit_scores, read_scores
from deepaccident_devkit.selection.splits import save_selection

pytestmark = pytest.mark.slow

NUM_PAIRS = 12
META_WITHOUT_COLLISION = re.sub("^.*", "ClearNoon -1 -1 -1 -1 -1 -1 -1 14", META_TEXT)
ScoreFunction = Callable[[Mapping[str, Any], np.random.Generator], float]


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Write twins of two agents in three towns, and one scenario without meta.

    Accidents have 2 to 8 frames, their twins 7 to 13.
    """
    root = tmp_path_factory.mktemp("audit") / "release"
    rng = np.random.default_rng(0)
    for number in range(NUM_PAIRS):
        for kind, min_frames, meta in (
            ("accident", 2, META_TEXT),
            ("normal", 7, META_WITHOUT_COLLISION),
        ):
            frames = int(rng.integers(min_frames, min_frames + 7))
            write_tiny_release(
                root,
                frames=frames,
                agents=("ego_vehicle", "infrastructure"),
                scenario_type=f"type1_subtype1_{kind}",
                name=f"Town0{number % 3 + 1}_type001_subtype0001_scenario{number:05d}",
                meta=meta.replace(" 14\n", f" {frames + 10}\n"),
            )
    write_tiny_release(root, frames=2, scenario_type="type1_subtype2_normal", meta=None)
    return DeepAccident(dataroot=root, verbose=False)


def score_scenarios(release: DeepAccident, score: ScoreFunction) -> dict[str, float]:
    rng = np.random.default_rng(1)
    return {
        scenario["token"]: float(score(dict(scenario), rng))
        for scenario in release.scenario
        if scenario["weather"]
    }


def score_samples(release: DeepAccident, score: ScoreFunction) -> dict[str, float]:
    """Score each sample as a record that has its scenario's fields, too."""
    rng = np.random.default_rng(1)
    scores = {}
    for sample in release.sample:
        record = {**release.get("scenario", sample["scenario_token"]), **sample}
        if record["weather"]:
            scores[record["token"]] = float(score(record, rng))
    return scores


def frame_number(sample: Mapping[str, Any]) -> int:
    return int(sample["token"][-3:])


def score_randomly(_record: Mapping[str, Any], rng: np.random.Generator) -> float:
    return rng.random()


def score_truth(record: Mapping[str, Any], _rng: np.random.Generator) -> float:
    return record["collision"] is not None


def attribute_row(report: AuditReport, name: str) -> list[float]:
    rows = {row[0]: [*row[1:]] for row in report.tables["scores"]}
    return rows[name]  # type: ignore[return-value]


def finding_kinds(report: AuditReport) -> list[str]:
    return [finding.kind for finding in report.findings]


@pytest.mark.parametrize("score_all", [score_scenarios, score_samples])
@pytest.mark.parametrize(
    "score",
    [
        lambda record, _rng: -record["num_frames"],
        lambda record, rng: -record["num_frames"] + 0.3 * rng.normal(),
    ],
    ids=["length", "length with noise"],
)
def test_the_length_of_clips_is_reported(
    release: DeepAccident, score_all: Any, score: ScoreFunction
) -> None:
    report = audit_scores(release, score_all(release, score))
    assert finding_kinds(report) == ["length"]
    assert "a detector of short clips" in report.findings[0].what
    area, correlation, low, high, within_accidents, *_ = attribute_row(report, "length")
    assert area > 0.9
    assert -1 <= low <= correlation <= high < -0.8
    assert within_accidents < -0.8


@pytest.mark.parametrize(
    ("score_all", "score"),
    [
        (score_scenarios, score_randomly),
        (score_samples, score_randomly),
        (score_scenarios, score_truth),
        (score_scenarios, lambda record, rng: score_truth(record, rng) + 0.2 * rng.random()),
        (score_samples, score_truth),
        (  # rises towards the accident
            score_samples,
            lambda record, rng: (
                score_truth(record, rng) * frame_number(record) / record["num_frames"]
                + rng.random() / 9
            ),
        ),
    ],
    ids=["random", "random samples", "truth", "truth with noise", "truth of samples", "rising"],
)
def test_other_scores_are_not_reported(
    release: DeepAccident, score_all: Any, score: ScoreFunction
) -> None:
    assert finding_kinds(audit_scores(release, score_all(release, score))) == []


def test_the_truth_is_not_called_its_length_though_the_length_separates_it(
    release: DeepAccident,
) -> None:
    report = audit_scores(release, score_scenarios(release, score_truth))
    assert attribute_row(report, "the scores")[0] == 1
    area, correlation, _, _, *within_classes = attribute_row(report, "length")
    assert area > 0.9
    assert correlation < -0.7
    assert within_classes == [0, 0, 0]


@pytest.mark.parametrize(
    ("kind", "description", "score_all", "score"),
    [
        (
            "town",
            "a detector of towns",
            score_scenarios,
            lambda record, _rng: int(record["town"][-1]) % 3,
        ),
        (
            "name",
            "a detector of large numbers in names",
            score_scenarios,
            lambda record, _rng: int(record["name"][-5:]),
        ),
        (
            "length",
            "a detector of long clips",
            score_scenarios,
            lambda record, _rng: record["num_frames"],
        ),
        (
            "frame",
            "a detector of late frames",
            score_samples,
            lambda record, _rng: frame_number(record),
        ),
        (
            "frame",
            "a detector of early frames",
            score_samples,
            lambda record, _rng: -frame_number(record),
        ),
    ],
)
def test_scores_that_follow_another_attribute_are_reported(
    release: DeepAccident, kind: str, description: str, score_all: Any, score: ScoreFunction
) -> None:
    report = audit_scores(release, score_all(release, score))
    descriptions = {finding.kind: finding.what for finding in report.findings}
    assert description in descriptions[kind]


def test_areas_follow_from_pairs_of_scenarios(release: DeepAccident) -> None:
    """Twins share name and town, so these tell nothing; here the folder and META's weather tell
    everything.
    """
    report = audit_scores(release, score_samples(release, score_randomly))
    attributes = ("folder", "name", "town", "weather", "actors")
    areas = {attribute: attribute_row(report, attribute)[0] for attribute in attributes}
    assert areas == {"folder": 1, "name": 0.5, "town": 0.5, "weather": 1, "actors": 0.5}

    scenarios = [scenario for scenario in release.scenario if scenario["weather"]]
    accidents = [scenario for scenario in scenarios if scenario["collision"]]
    twins = [scenario for scenario in scenarios if not scenario["collision"]]
    num_shorter = 0
    num_equal = 0
    for accident in accidents:
        for twin in twins:
            num_shorter += accident["num_frames"] < twin["num_frames"]
            num_equal += accident["num_frames"] == twin["num_frames"]
    area = (num_shorter + num_equal / 2) / (len(accidents) * len(twins))
    assert attribute_row(report, "length")[0] == round(area, 3)


def test_leaving_a_scenario_out_of_its_own_share_makes_no_area(release: DeepAccident) -> None:
    """Without twins, a town has fewer other collisions for each collision, which must not look like
    a sign.
    """
    scores = score_scenarios(release, score_randomly)
    scores_without_twins = {}
    for token, score in scores.items():
        is_accident = "accident" in token
        if is_accident == (int(token[-5:]) < NUM_PAIRS / 2):
            scores_without_twins[token] = score
    report = audit_scores(release, scores_without_twins)
    assert attribute_row(report, "town")[0] == 0.5


def test_a_split_gives_the_same_numbers_as_only_its_scores(
    release: DeepAccident, tmp_path: Path
) -> None:
    scores = score_scenarios(release, score_randomly)
    selected = [token for token in scores if int(token[-5:]) < 8]
    split = save_selection(selected, tmp_path / "chosen.txt")
    report = audit_scores(release, scores, split)
    assert report.notes[0] == "16 scenarios with meta and a score, 8 with a collision."

    selected_scores = {token: scores[token] for token in reversed(selected)}
    assert report.to_json() == audit_scores(release, selected_scores).to_json()
    score_row = json.loads(report.to_json())["tables"]["scores"][1]
    assert score_row[:2] == ["the scores", attribute_row(report, "the scores")[0]]


def test_few_scenarios_give_no_verdict(release: DeepAccident) -> None:
    scores = score_scenarios(release, lambda record, _rng: -record["num_frames"])
    few_scores = {token: score for token, score in scores.items() if int(token[-5:]) < 3}
    report = audit_scores(release, few_scores)
    assert (finding_kinds(report), report.exit_status) == ([], 2)
    assert "fewer than 6" in report.cannot_say[0]


def test_attributes_that_agree_with_the_truth_are_named(release: DeepAccident) -> None:
    """Here the name of each folder is right."""
    for score in (lambda record, _rng: record["designed_accident"], score_randomly):
        report = audit_scores(release, score_scenarios(release, score))
        assert (finding_kinds(report), report.exit_status) == ([], 0)
        assert report.cannot_say[0].startswith("folder, weather, actors, frame: ")


@pytest.fixture(scope="module")
def odd_release(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Write a release in which, as in val, the folder of some scenarios is wrong: two accidents
    have no collision, and one normal scenario has one.
    """
    root = tmp_path_factory.mktemp("odd") / "release"
    for number in range(NUM_PAIRS):
        for kind, meta in (
            ("accident", META_WITHOUT_COLLISION if number < 2 else META_TEXT),
            ("normal", META_TEXT if number == 2 else META_WITHOUT_COLLISION),
        ):
            write_tiny_release(
                root,
                frames=4,
                agents=("ego_vehicle",),
                scenario_type=f"type1_subtype1_{kind}",
                name=f"Town03_type001_subtype0001_scenario{number:05d}",
                meta=meta,
            )
    return DeepAccident(dataroot=root, verbose=False)


@pytest.mark.parametrize(
    ("score", "kinds"),
    [
        (lambda record, _rng: record["designed_accident"], ["folder"]),
        (lambda record, _rng: -5.0 * record["designed_accident"], ["folder"]),
        (lambda record, rng: record["designed_accident"] + 0.3 * rng.random(), ["folder"]),
        (lambda record, rng: np.exp(record["designed_accident"] + 0.3 * rng.random()), ["folder"]),
        (score_truth, []),
        (lambda record, rng: score_truth(record, rng) + 0.3 * rng.random(), []),
        (score_randomly, []),
    ],
)
def test_the_folders_name_is_told_apart_from_the_truth(
    odd_release: DeepAccident, score: ScoreFunction, kinds: list[str]
) -> None:
    report = audit_scores(odd_release, score_scenarios(odd_release, score))
    assert (finding_kinds(report), report.exit_status) == (kinds, len(kinds))
    assert "folder" not in report.cannot_say[0]


def test_scores_of_unknown_scenarios_and_of_none_are_refused(release: DeepAccident) -> None:
    with pytest.raises(TokenError, match="no scenario 'a/b'"):
        audit_scores(release, {"a/b": 1.0})
    scenarios = release.scenario
    without_meta = next(scenario["token"] for scenario in scenarios if not scenario["weather"])
    for scores in ({}, {without_meta: 1.0}):
        with pytest.raises(ResultsError, match="no scenario with meta has a score"):
            audit_scores(release, scores)


def test_scores_are_read_from_many_kinds_of_files(release: DeepAccident, tmp_path: Path) -> None:
    sample, other = release.sample[0]["token"], release.sample[1]["token"]
    path = tmp_path / "scores.csv"
    path.write_text(f'token,score\n"{sample}",0.5\n\n{other}, 2e-1\n')
    assert read_scores(path) == {sample: 0.5, other: 0.2}
    for number, content in enumerate(
        (
            f",token,score\n0,{sample},0.5\n1,{other},2e-1\n",
            f"0;{sample};0,5\r\n1;{other};0,2\r\n",
            f"token\tscore\n{sample}\t0.5\n{other}\t.2",
            f"| {sample} | 0.5 \n| {other} | 0.2",
            f'\ufeff"0","{sample}","0.5"\n"1","{other}","0.2"\n',
        )
    ):
        suffix = ("csv", "tsv", "TXT")[number % 3]
        path = tmp_path / f"scores{number}.{suffix}"
        path.write_text(content, encoding="utf-8", newline="")
        assert read_scores(path) == {sample: 0.5, other: 0.2}, content
    path = tmp_path / "scores.json"
    for scores in (
        {sample: 1, other: 0.25},
        [{"token": sample, "score": 1, "id": 3}, {"token": other, "score": 0.25}],
    ):
        path.write_text(json.dumps(scores))
        assert read_scores(path) == {sample: 1, other: 0.25}

    accidents = [
        Accident(positions=np.zeros((2, 2)), time=1.0, score=score) for score in (0.3, 0.7)
    ]
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        writer.add(sample, accidents)
        writer.add(other, [])
    assert read_scores(tmp_path / "results.json") == {sample: 0.7, other: 0.0}

    document = json.loads((tmp_path / "results.json").read_text())
    document |= {"task": "detection", "results": {sample: []}}
    (tmp_path / "boxes.json").write_text(json.dumps(document))
    (tmp_path / "folder").mkdir()
    for name, content, message in (
        ("boxes.json", None, "expected a score, found "),
        ("no.json", None, "cannot be read"),
        ("folder", None, "not a regular file"),
        ("odd.csv", f"{sample},much", "expected a score, found .*: None"),
        ("odd.csv", f"score,token\n0.5,{sample}", "line 2: expected a token and its score"),
        ("odd.csv", f"{sample} 0.5", "line 1: .*a comma, a semicolon, a tab or a bar"),
        ("odd.csv", f"{sample},0.5,1", "expected a score, found .*: None"),
        ("odd.csv", "\x00".join(sample), "line 1: "),
        ("odd.json", '[{"token": "a/b"}]', "expected an object of token and score"),
        ("odd.json", "null", "expected an object of token and score"),
        ("odd.json", f'{{"{sample}": 1{400 * "0"}}}', "expected a score, found"),
        ("odd.csv", f"{sample},nan", "expected a score, found .*: nan"),
        ("odd.json", "[1, 2]", "expected an object of token and score"),
        ("odd.json", f'{{"{sample}": true}}', "expected a score, found .*: True"),
        ("odd.json", "{", "is not JSON"),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(ResultsError, match=rf"{re.escape(name)}: .*{message}"):
            read_scores(tmp_path / name)
