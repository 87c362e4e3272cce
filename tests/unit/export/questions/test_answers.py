"""Answers: read back as accidents, and evaluated; malformed ones are refused with file, line and
remedy.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from question_files import Asked, ask
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, ResultsError
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.questions import (
    Questions,
    WindowRules,
    read_answers,
    results_of_answers,
)

Lines = list[dict[str, Any]]
SPLIT = "train"
EGOS = ("ego_vehicle", "ego_vehicle_behind")


@pytest.fixture(scope="module")
def asked(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Asked:
    """All samples that evaluations have of two agents."""
    form = Questions(observers="all", window=WindowRules(observe=0, stride=0.5), agents=EGOS)
    return ask(da_motion, tmp_path_factory.mktemp("asked"), form)


def perfect(asked: Asked) -> Lines:
    """The answers of one who knows the truth."""
    return [
        {
            "accident": [*map(bool, each["accident"])],
            **{name: each[name] for name in ("id", "who", "where", "when")},
        }
        for each in asked.truth.values()
    ]


def written(path: Path, lines: Lines) -> Path:
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    return path


def results(asked: Asked, folder: Path, answers: Lines) -> Path:
    out = folder / "accident.json"
    results_of_answers(
        written(folder / "answers.jsonl", answers), asked.done.folder / "truth.jsonl", out
    )
    return out


def evaluated(dataset: DeepAccident, path: Path, task: Any) -> Any:
    listed = "all" if task == "warning" else "evaluate"
    selection = SampleSelection(split=SPLIT, samples=listed, scope="all", horizon=3.0, agents=EGOS)
    setup = EvaluationSetup(
        task=task, protocol="clean" if task == "warning" else "boxes", horizon=3.0
    )
    partial = task == "accident"  # whose list lacks some samples that were asked about
    return evaluate_results(dataset, path, setup, selection, workers=1, allow_partial=partial)


def test_one_who_knows_the_truth_gets_full_marks(
    da_motion: DeepAccident, asked: Asked, tmp_path: Path
) -> None:
    path = results(asked, tmp_path, perfect(asked))
    run = evaluated(da_motion, path, "accident")
    assert run.partial is None
    found = run.result
    assert (found.apa, found.precision, found.recall, found.average_precision) == (1, 1, 1, 1)
    assert (found.false_alarm_rate, found.id_error) == (0, 0)
    warned = evaluated(da_motion, path, "warning")
    assert warned.partial is None
    at = warned.result.groups["ego_involved"].operating
    assert (at.recall, at.precision, at.time_in_alarm, at.tta0) == (1, 1, 0, pytest.approx(3.0))


def test_answers_become_accidents(asked: Asked, tmp_path: Path) -> None:
    sample = next(
        sample for sample, truth in asked.truth.items() if truth["who"] and None not in truth["who"]
    )
    truth = asked.truth[sample]
    base = {
        "id": truth["id"],
        "accident": [0.2, 0.9, 0.9],
        "who": truth["who"][::-1],
        "where": [[1, 2], [3.5, -4]],
    }

    def alarms(threshold: float = 0.5, **changes: Any) -> Any:
        path = written(tmp_path / "answers.jsonl", [{**base, **changes}])
        read = read_answers(path, asked.done.folder / "truth.jsonl", threshold=threshold)
        assert (read.answered, len(read.missing)) == (1, len(asked.truth) - 1)
        assert set(asked.truth) < set(read.accidents)
        assert read.alarms == len(read.accidents[sample])
        return read.accidents[sample]

    whole = {
        "time": 1.5,
        "score": 0.9,
        "ids": tuple(truth["actor_ids"][::-1]),
        "positions": [[1, 2], [3.5, -4]],
    }
    for threshold, changes, told in (
        (0.5, {}, {}),
        (0.5, {"when": 1.8, "why": "it does not brake"}, {"time": 1.8}),
        (0.5, {"when": 2.0}, {"time": 2.0}),
        (0.5, {"when": 1.0}, {}),  # of another second
        (0.5, {"accident": [False, 0.6, True]}, {"time": 2.5, "score": 1.0}),
        (0.5, {"where": [7, 8]}, {"positions": [[7, 8], [7, 8]]}),
        (0.5, {"who": None}, {"ids": None}),
        (0.5, {"who": [truth["who"][0], None]}, {"ids": None}),
        (0.9, {}, {}),
        (0.0, {"accident": [0.01, 0, 0]}, {"time": 0.5, "score": 0.01}),
    ):
        (alarm,) = alarms(threshold, **changes)
        found = {
            "time": alarm.time,
            "score": alarm.score,
            "ids": alarm.ids,
            "positions": alarm.positions.tolist(),
        }
        assert found == {**whole, **told}
    assert alarms(0.91) == alarms(accident=[0, 0, 0.4]) == alarms(0, accident=[False] * 3) == []


def test_the_results_file(asked: Asked, tmp_path: Path) -> None:
    lines = [line for line in perfect(asked) if line["when"] != 1.0]
    out, truth = tmp_path / "accident.json", asked.done.folder / "truth.jsonl"
    told = results_of_answers(
        written(tmp_path / "answers", lines), truth, out, threshold=0.3, meta={"method": "mine"}
    )
    read = read_results(out)
    assert (
        sorted(told.missing)
        == sorted(each["id"] for each in asked.truth.values() if each["when"] == 1.0)
        != []
    )
    assert read.meta == {
        "questions": len(asked.truth),
        "answered": len(lines),
        "threshold": 0.3,
        "method": "mine",
    }
    ends = {f"{sample[:-3]}035" for sample in asked.truth}
    alarms = {
        sample: True in each["accident"] and each["when"] != 1.0
        for sample, each in asked.truth.items()
    }
    assert {token: len(read.prediction(token)) for token in read.tokens} == alarms | dict.fromkeys(
        ends, 0
    )
    with pytest.raises(ResultsError, match=f"^{out}: "):
        results_of_answers(tmp_path / "answers", truth, out)


GOOD: dict[str, Any] = {"accident": [False, 0.7, False], "who": None, "where": [0, 1]}


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ("{", "no JSON"),
        ("[1]", "`object`, got `array`.*README.md"),
        ({"id": "0000"}, "id: '0000'"),
        ({"id": None}, r"\$\.id"),
        ({"wher": 1}, "`wher`"),
        ({"accident": [True]}, "accident: .*3 times"),
        ({"accident": [0, 0, 1.2]}, r"\$\.accident\[2\]"),
        ({"accident": [0, 0, "yes"]}, r"\$\.accident\[2\]"),
        ({"accident": True}, r"\$\.accident"),
        ({"who": ["ego"]}, r"\$\.who"),
        ({"who": ["ego", "a999"]}, "who: 'a999'.*write null"),
        ({"who": ["ego", 4]}, r"\$\.who\[1\]"),
        ({"who": ["ego", "ego"]}, "who: 'ego'"),
        ({"where": [1]}, r"\$\.where"),
        ({"where": [[1, 2], [3]]}, r"\$\.where\[1\]"),
        ({"where": [[1, 2], 3]}, r"where: expected \[x, y\]"),
        ({"where": [1, 1e9]}, r"1000000\.0 - at `\$\.where\[1\]`"),
        ({"where": [True, 1]}, r"\$\.where\[0\]"),
        ({"where": "here"}, r"\$\.where"),
        ({"where": None}, "where: "),
        ({"when": -1}, r"\$\.when"),
        ({"when": 10**400}, r"\$\.when"),
        ({"when": "soon"}, r"\$\.when"),
        ({"x" * 10**6: 1}, "`x{10,60} … x{10,60}`"),
    ],
)
def test_malformed_answers(asked: Asked, tmp_path: Path, change: Any, facts: str) -> None:
    truth = [each for each in asked.truth.values() if "ego" in each["actors"]]
    lines = [{"id": each["id"], **GOOD} for each in truth[:2]]
    wrong = change if isinstance(change, str) else json.dumps({**lines[1], **change})
    path = tmp_path / "answers.jsonl"
    path.write_text(f"{json.dumps(lines[0])}\n\n{wrong}\n")
    with pytest.raises(ResultsError, match=f"^{path}:3: .*{facts}"):
        read_answers(path, asked.done.folder / "truth.jsonl")


@pytest.mark.parametrize("name", ["id", "accident", "who", "where"])
def test_an_answer_that_lacks_something_or_comes_twice(
    asked: Asked, tmp_path: Path, name: str
) -> None:
    whole = {"id": next(iter(asked.truth.values()))["id"], **GOOD}
    lacking = {key: each for key, each in whole.items() if key != name}
    path, truth = written(tmp_path / "a.jsonl", [whole, lacking]), asked.done.folder / "truth.jsonl"
    twice = written(tmp_path / "b.jsonl", [whole, whole])
    assert_refused(
        (
            lambda: read_answers(path, truth),
            ResultsError,
            (f"{path}:2: ", f"required field `{name}`", "mend that line"),
        ),
        (
            lambda: read_answers(twice, truth),
            ResultsError,
            (f"{twice}:2: id: {whole['id']}", "line 1", "leave one"),
        ),
    )


def test_files_that_are_something_else(asked: Asked, tmp_path: Path) -> None:
    path, truth = (
        written(tmp_path / "answers.jsonl", perfect(asked)),
        asked.done.folder / "truth.jsonl",
    )
    empty = written(tmp_path / "empty", [])
    assert_refused(
        (
            lambda: read_answers(path, path),
            ResultsError,
            (f"{path}:1: ", "no line of a truth file", "give truth.jsonl"),
        ),
        (
            lambda: read_answers(tmp_path / "none", truth),
            ResultsError,
            f"^{tmp_path}/none: cannot be read",
        ),
        (lambda: read_answers(path, empty), ResultsError, f"^{empty}: holds no question"),
        (
            lambda: read_answers(path, truth, threshold=1.5),
            ConfigError,
            ("threshold", "from 0 to 1", "1.5"),
        ),
    )
    assert read_answers(empty, truth).alarms == 0


@pytest.mark.parametrize(
    ("name", "value", "place"),
    [
        ("id", 3, r"\$\.id"),
        ("sample", "a/b", r"\$\.sample"),
        ("sample", ["a/b/c/001"], r"\$\.sample"),
        ("last_frame", "9", r"\$\.last_frame"),
        ("last_frame", 10**30, r"\$\.last_frame"),
        ("accident", [], r"\$\.accident"),
        ("accident", None, r"\$\.accident"),
        ("actors", [["ego", 1]], r"\$\.actors"),
        ("actors", {"ego": 2**70}, r"\$\.actors\[\.\.\.\]"),
        ("actors", {"ego": {}}, r"\$\.actors\[\.\.\.\]"),
    ],
)
def test_a_truth_file_that_was_changed(
    asked: Asked, tmp_path: Path, name: str, value: Any, place: str
) -> None:
    """The record names line and field; no other exception comes of what is in a truth file."""
    lines = [{**each} for each in asked.truth.values()]
    lines[1][name] = value
    truth, answers = (
        written(tmp_path / "truth.jsonl", lines),
        written(tmp_path / "answers.jsonl", perfect(asked)),
    )
    assert_refused(
        (
            lambda: read_answers(answers, truth),
            ResultsError,
            f"^{truth}:2: .* - at `{place}`; this is no line of a truth file; give ",
        )
    )


def test_the_command(asked: Asked, tmp_path: Path) -> None:
    answers, out = (
        written(tmp_path / "answers.jsonl", perfect(asked)[1:]),
        tmp_path / "accident.json",
    )
    words = [
        str(answers),
        "--truth",
        str(asked.done.folder / "truth.jsonl"),
        "--out",
        str(out),
        "--method",
        "mine",
    ]
    said = CliRunner().invoke(deepaccident, ["results", *words], catch_exceptions=False).stdout
    assert (read_results(out).meta["method"], "1 questions" in said) == ("mine", True)
