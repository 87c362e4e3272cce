"""Scores that are a clip's length, a town or a clock are told; random ones, the truth and good
detectors are not.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny import META, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError, TokenError
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.plugins.audit import AuditReport, audit_scores, read_scores
from deepaccident_devkit.selection.splits import save_selection

pytestmark = pytest.mark.slow

PAIRS = 12
SILENT = re.sub("^.*", "ClearNoon -1 -1 -1 -1 -1 -1 -1 14", META)
Made = Callable[[Mapping[str, Any], np.random.Generator], float]


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Twins of two agents in three towns; an accident has 2 to 8 frames, its twin 7 to 13. One has
    no meta.
    """
    root, rng = tmp_path_factory.mktemp("audit") / "release", np.random.default_rng(0)
    for number in range(PAIRS):
        for kind, low, meta in (("accident", 2, META), ("normal", 7, SILENT)):
            frames = int(rng.integers(low, low + 7))
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


def of_scenarios(release: DeepAccident, score: Made) -> dict[str, float]:
    rng = np.random.default_rng(1)
    return {
        each["token"]: float(score(dict(each), rng)) for each in release.scenario if each["weather"]
    }


def of_samples(release: DeepAccident, score: Made) -> dict[str, float]:
    rng = np.random.default_rng(1)
    scenarios = {each["token"]: each for each in release.scenario}
    samples = [{**scenarios[each["scenario_token"]], **each} for each in release.sample]
    return {each["token"]: float(score(each, rng)) for each in samples if each["weather"]}


def frame_of(sample: Mapping[str, Any]) -> int:
    return int(sample["token"][-3:])


def row_of(report: AuditReport, name: str) -> list[float]:
    return next([*row[1:]] for row in report.tables["scores"] if row[0] == name)  # type: ignore[misc]


def kinds(report: AuditReport) -> list[str]:
    return [finding.kind for finding in report.findings]


@pytest.mark.parametrize("of", [of_scenarios, of_samples])
@pytest.mark.parametrize(
    "score",
    [
        lambda each, _rng: -each["num_frames"],
        lambda each, rng: -each["num_frames"] + 0.3 * rng.normal(),
    ],
    ids=["length", "length with noise"],
)
def test_the_length_of_clips_is_told(release: DeepAccident, of: Any, score: Made) -> None:
    report = audit_scores(release, of(release, score))
    assert kinds(report) == ["length"]
    assert "a detector of short clips" in report.findings[0].what
    area, overall, low, high, within, *_ = row_of(report, "length")
    assert area > 0.9
    assert -1 <= low <= overall <= high < -0.8
    assert within < -0.8


@pytest.mark.parametrize(
    ("of", "score"),
    [
        (of_scenarios, lambda _each, rng: rng.random()),
        (of_samples, lambda _each, rng: rng.random()),
        (of_scenarios, lambda each, _rng: each["collision"] is not None),
        (of_scenarios, lambda each, rng: (each["collision"] is not None) + 0.2 * rng.random()),
        (of_samples, lambda each, _rng: each["collision"] is not None),
        (  # rises towards the accident
            of_samples,
            lambda each, rng: (
                (each["collision"] is not None) * frame_of(each) / each["num_frames"]
                + rng.random() / 9
            ),
        ),
    ],
    ids=["random", "random samples", "truth", "truth with noise", "truth of samples", "rising"],
)
def test_other_scores_are_not_told(release: DeepAccident, of: Any, score: Made) -> None:
    assert kinds(audit_scores(release, of(release, score))) == []


def test_the_truth_is_not_called_its_length_though_the_length_separates_it(
    release: DeepAccident,
) -> None:
    report = audit_scores(
        release, of_scenarios(release, lambda each, _rng: each["collision"] is not None)
    )
    assert row_of(report, "the scores")[0] == 1
    area, overall, _, _, *within = row_of(report, "length")
    assert area > 0.9
    assert overall < -0.7
    assert within == [0, 0, 0]


@pytest.mark.parametrize(
    ("kind", "said", "of", "score"),
    [
        ("town", "a detector of towns", of_scenarios, lambda each, _rng: int(each["town"][-1]) % 3),
        (
            "name",
            "a detector of large numbers in names",
            of_scenarios,
            lambda each, _rng: int(each["name"][-5:]),
        ),
        ("length", "a detector of long clips", of_scenarios, lambda each, _rng: each["num_frames"]),
        ("frame", "a detector of late frames", of_samples, lambda each, _rng: frame_of(each)),
        ("frame", "a detector of early frames", of_samples, lambda each, _rng: -frame_of(each)),
    ],
)
def test_other_attributes(
    release: DeepAccident, kind: str, said: str, of: Any, score: Made
) -> None:
    report = audit_scores(release, of(release, score))
    assert {finding.kind: said in finding.what for finding in report.findings}[kind]


def test_areas(release: DeepAccident) -> None:
    """Twins share name and town, which so tell nothing; the folder tells all here, and the weather
    of META too.
    """
    report = audit_scores(release, of_samples(release, lambda _each, rng: rng.random()))
    areas = {
        name: row_of(report, name)[0] for name in ("folder", "name", "town", "weather", "actors")
    }
    assert areas == {"folder": 1, "name": 0.5, "town": 0.5, "weather": 1, "actors": 0.5}
    scenarios = [each for each in release.scenario if each["weather"]]
    pairs = [
        (one["num_frames"] < other["num_frames"]) + (one["num_frames"] == other["num_frames"]) / 2
        for one in scenarios
        for other in scenarios
        if one["collision"] and not other["collision"]
    ]
    assert row_of(report, "length")[0] == round(sum(pairs) / len(pairs), 3)


def test_leaving_a_scenario_out_of_its_own_share_makes_no_area(release: DeepAccident) -> None:
    """Without twins, the other collisions of a collision's town are fewer, which must not look like
    a sign.
    """
    scores = of_scenarios(release, lambda _each, rng: rng.random())
    alone = {
        token: score
        for token, score in scores.items()
        if ("accident" in token) == (int(token[-5:]) < PAIRS / 2)
    }
    assert row_of(audit_scores(release, alone), "town")[0] == 0.5


def test_a_split_and_the_same_numbers_again(release: DeepAccident, tmp_path: Path) -> None:
    scores = of_scenarios(release, lambda _each, rng: rng.random())
    chosen = [token for token in scores if int(token[-5:]) < 8]
    path = save_selection(chosen, tmp_path / "chosen.txt")
    report = audit_scores(release, scores, path)
    assert report.notes[0] == "16 scenarios with meta and a score, 8 with a collision."
    few = {token: scores[token] for token in reversed(chosen)}
    assert report.to_json() == audit_scores(release, few).to_json()
    assert json.loads(report.to_json())["tables"]["scores"][1][:2] == [
        "the scores",
        row_of(report, "the scores")[0],
    ]


def test_few_scenarios_give_no_verdict(release: DeepAccident) -> None:
    scores = of_scenarios(release, lambda each, _rng: -each["num_frames"])
    report = audit_scores(
        release, {token: scores[token] for token in scores if int(token[-5:]) < 3}
    )
    assert (kinds(report), report.exit_status) == ([], 2)
    assert "fewer than 6" in report.cannot_say[0]


def test_what_cannot_be_told_apart_from_the_truth_is_said(release: DeepAccident) -> None:
    """Each folder's word is right here."""
    for score in (lambda each, _rng: each["designed_accident"], lambda _each, rng: rng.random()):
        report = audit_scores(release, of_scenarios(release, score))
        assert (kinds(report), report.exit_status) == ([], 0)
        assert report.cannot_say[0].startswith("folder, weather, actors, frame: ")


@pytest.fixture(scope="module")
def odd_release(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """As in val, some scenarios end otherwise than their folder says: two without a collision, and
    one with.
    """
    root = tmp_path_factory.mktemp("odd") / "release"
    for number in range(PAIRS):
        for kind, meta in (
            ("accident", SILENT if number < 2 else META),
            ("normal", META if number == 2 else SILENT),
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
    ("score", "found"),
    [
        (lambda each, _rng: each["designed_accident"], ["folder"]),
        (lambda each, _rng: -5.0 * each["designed_accident"], ["folder"]),
        (lambda each, rng: each["designed_accident"] + 0.3 * rng.random(), ["folder"]),
        (lambda each, rng: np.exp(each["designed_accident"] + 0.3 * rng.random()), ["folder"]),
        (lambda each, _rng: each["collision"] is not None, []),
        (lambda each, rng: (each["collision"] is not None) + 0.3 * rng.random(), []),
        (lambda _each, rng: rng.random(), []),
    ],
)
def test_the_folders_word_is_told_from_the_truth(
    odd_release: DeepAccident, score: Made, found: list[str]
) -> None:
    report = audit_scores(odd_release, of_scenarios(odd_release, score))
    assert (kinds(report), report.exit_status) == (found, len(found))
    assert "folder" not in report.cannot_say[0]


def test_refused(release: DeepAccident) -> None:
    with pytest.raises(TokenError, match="no scenario 'a/b'"):
        audit_scores(release, {"a/b": 1.0})
    unknown = next(each["token"] for each in release.scenario if not each["weather"])
    for scores in ({}, {unknown: 1.0}):
        with pytest.raises(ResultsError, match="no scenario with meta has a score"):
            audit_scores(release, scores)


def test_files_of_scores(release: DeepAccident, tmp_path: Path) -> None:
    sample, other = release.sample[0]["token"], release.sample[1]["token"]
    path = tmp_path / "scores.csv"
    path.write_text(f'token,score\n"{sample}",0.5\n\n{other}, 2e-1\n')
    assert read_scores(path) == {sample: 0.5, other: 0.2}
    for number, lines in enumerate(
        (
            f",token,score\n0,{sample},0.5\n1,{other},2e-1\n",
            f"0;{sample};0,5\r\n1;{other};0,2\r\n",
            f"token\tscore\n{sample}\t0.5\n{other}\t.2",
            f"| {sample} | 0.5 \n| {other} | 0.2",
            f'\ufeff"0","{sample}","0.5"\n"1","{other}","0.2"\n',
        )
    ):
        path = tmp_path / f"scores{number}.{('csv', 'tsv', 'TXT')[number % 3]}"
        path.write_text(lines, encoding="utf-8", newline="")
        assert read_scores(path) == {sample: 0.5, other: 0.2}, lines
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
    document = json.loads((tmp_path / "results.json").read_text()) | {
        "task": "detection",
        "results": {sample: []},
    }
    (tmp_path / "boxes.json").write_text(json.dumps(document))
    (tmp_path / "folder").mkdir()
    for name, content, told in (
        ("boxes.json", None, "expected a score, found "),
        ("no.json", None, "cannot be read"),
        ("folder", None, "not a regular file"),
        ("odd.csv", f"{sample},much", "expected a score, found .*: None"),
        ("odd.csv", f"score,token\n0.5,{sample}", "line 2: expected a token and then its score"),
        ("odd.csv", f"{sample} 0.5", "line 1: .*a comma, a semicolon, a tab or a bar"),
        ("odd.csv", f"{sample},0.5,1", "expected a score, found .*: None"),
        ("odd.csv", "\x00".join(sample), "line 1: "),
        ("odd.json", '[{"token": "a/b"}]', "expected an object of token and score"),
        ("odd.json", "null", "expected an object of token and score"),
        ("odd.json", f'{{"{sample}": 1{400 * "0"}}}', "expected a score, found"),
        ("odd.csv", f"{sample},nan", "expected a score, found .*: nan"),
        ("odd.json", "[1, 2]", "expected an object of token and score"),
        ("odd.json", f'{{"{sample}": true}}', "expected a score, found .*: True"),
        ("odd.json", "{", "is no JSON"),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(ResultsError, match=rf"{re.escape(name)}: .*{told}"):
            read_scores(tmp_path / name)
