"""Read answers back as accidents, evaluate them, and refuse malformed ones with file and line."""

import json
from pathlib import Path
from typing import Any

import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.question_files import QuestionFiles, export_and_read

from deepaccident_devkit import DeepAccident
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
def questions(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> QuestionFiles:
    """Questions about all evaluated samples of two agents."""
    return export_and_read(
        da_motion,
        tmp_path_factory.mktemp("asked"),
        Questions(observers="all", window=WindowRules(observe=0, stride=0.5), agents=EGOS),
    )


@pytest.fixture(scope="module")
def truth_file(questions: QuestionFiles) -> Path:
    return questions.done.folder / "truth.jsonl"


def make_perfect_answers(questions: QuestionFiles) -> Lines:
    answers = []
    for truth in questions.truth.values():
        answer = {name: truth[name] for name in ("id", "who", "where", "when")}
        answers.append({**answer, "accident": [bool(second) for second in truth["accident"]]})
    return answers


def write_lines(path: Path, lines: Lines) -> Path:
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    return path


def test_perfect_answers_get_full_marks_as_accidents(
    da_motion: DeepAccident, questions: QuestionFiles, truth_file: Path, tmp_path: Path
) -> None:
    answers = write_lines(tmp_path / "answers.jsonl", make_perfect_answers(questions))
    out = tmp_path / "accident.json"
    results_of_answers(answers, truth_file, out)

    def evaluate(task: Any, protocol: Any, samples: Any, *, allow_partial: bool) -> Any:
        setup = EvaluationSetup(task=task, protocol=protocol, horizon=3.0)
        selection = SampleSelection(
            split=SPLIT, samples=samples, scope="all", horizon=3.0, agents=EGOS
        )
        return evaluate_results(
            da_motion, out, setup, selection, workers=1, allow_partial=allow_partial
        )

    # there are questions about samples that the accident task does not list
    run = evaluate("accident", "boxes", "evaluate", allow_partial=True)

    assert run.partial is None

    scores = run.result
    assert (scores.apa, scores.precision, scores.recall, scores.average_precision) == (1, 1, 1, 1)
    assert (scores.false_alarm_rate, scores.id_error) == (0, 0)

    run = evaluate("warning", "clean", "all", allow_partial=False)
    assert run.partial is None

    scores = run.result.groups["ego_involved"].operating
    assert (scores.recall, scores.precision, scores.time_in_alarm) == (1, 1, 0)
    assert scores.tta0 == pytest.approx(3.0)


def test_answers_become_accidents(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path
) -> None:
    truths = questions.truth.values()
    truth = next(truth for truth in truths if truth["who"] and None not in truth["who"])
    sample = truth["sample"]
    base = {
        "id": truth["id"],
        "accident": [0.2, 0.9, 0.9],
        "who": truth["who"][::-1],
        "where": [[1, 2], [3.5, -4]],
    }

    def read_alarms(threshold: float = 0.5, **changes: Any) -> Any:
        path = write_lines(tmp_path / "answers.jsonl", [{**base, **changes}])
        answers = read_answers(path, truth_file, threshold=threshold)
        assert (answers.answered, len(answers.missing)) == (1, len(questions.truth) - 1)
        assert set(questions.truth) < set(answers.accidents)
        assert answers.alarms == len(answers.accidents[sample])
        return answers.accidents[sample]

    unchanged = {
        "time": 1.5,
        "score": 0.9,
        "ids": tuple(truth["actor_ids"][::-1]),
        "positions": [[1, 2], [3.5, -4]],
    }
    for threshold, changes, differences in (
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
        (alarm,) = read_alarms(threshold, **changes)
        assert {
            "time": alarm.time,
            "score": alarm.score,
            "ids": alarm.ids,
            "positions": alarm.positions.tolist(),
        } == {**unchanged, **differences}

    assert read_alarms(0.91) == []
    assert read_alarms(accident=[0, 0, 0.4]) == []
    assert read_alarms(0, accident=[False] * 3) == []


def test_the_results_file_holds_all_accidents(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path
) -> None:
    lines = [line for line in make_perfect_answers(questions) if line["when"] != 1.0]
    path = write_lines(tmp_path / "answers", lines)
    out = tmp_path / "accident.json"
    answers = results_of_answers(path, truth_file, out, threshold=0.3, meta={"method": "mine"})
    truths = questions.truth.values()
    unanswered = [truth["id"] for truth in truths if truth["when"] == 1.0]

    assert sorted(answers.missing) == sorted(unanswered) != []

    results = read_results(out)
    assert results.meta == {
        "questions": len(questions.truth),
        "answered": len(lines),
        "threshold": 0.3,
        "method": "mine",
    }

    num_alarms = {}
    for sample, truth in questions.truth.items():
        num_alarms[sample] = int(True in truth["accident"] and truth["when"] != 1.0)
        num_alarms[f"{sample[:-3]}035"] = 0

    assert {token: len(results.prediction(token)) for token in results.tokens} == num_alarms
    with pytest.raises(ResultsError, match=f"^{out}: "):
        results_of_answers(path, truth_file, out)


GOOD_ANSWER: dict[str, Any] = {"accident": [False, 0.7, False], "who": None, "where": [0, 1]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("{", "not JSON"),
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
def test_malformed_answers_are_refused_by_line(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path, change: Any, message: str
) -> None:
    truths = [truth for truth in questions.truth.values() if "ego" in truth["actors"]]
    good, answer = ({"id": truth["id"], **GOOD_ANSWER} for truth in truths[:2])
    wrong_line = change if isinstance(change, str) else json.dumps({**answer, **change})
    path = tmp_path / "answers.jsonl"
    path.write_text(f"{json.dumps(good)}\n\n{wrong_line}\n")

    with pytest.raises(ResultsError, match=f"^{path}:3: .*{message}"):
        read_answers(path, truth_file)


@pytest.mark.parametrize("name", ["id", "accident", "who", "where"])
def test_incomplete_and_repeated_answers_are_refused(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path, name: str
) -> None:
    answer = {"id": next(iter(questions.truth.values()))["id"], **GOOD_ANSWER}
    incomplete = {key: value for key, value in answer.items() if key != name}
    path = write_lines(tmp_path / "a.jsonl", [answer, incomplete])
    repeated = write_lines(tmp_path / "b.jsonl", [answer, answer])

    assert_raises(
        (
            lambda: read_answers(path, truth_file),
            ResultsError,
            (f"{path}:2: ", f"required field `{name}`", "correct that line"),
        ),
        (
            lambda: read_answers(repeated, truth_file),
            ResultsError,
            (f"{repeated}:2: id: {answer['id']}", "line 1", "remove one"),
        ),
    )


def test_other_files_are_refused(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path
) -> None:
    path = write_lines(tmp_path / "answers.jsonl", make_perfect_answers(questions))
    empty = write_lines(tmp_path / "empty", [])
    assert_raises(
        (
            lambda: read_answers(path, path),
            ResultsError,
            (f"{path}:1: ", "not a line of a truth file", "give truth.jsonl"),
        ),
        (
            lambda: read_answers(tmp_path / "none", truth_file),
            ResultsError,
            f"^{tmp_path}/none: cannot be read",
        ),
        (lambda: read_answers(path, empty), ResultsError, f"^{empty}: contains no question"),
        (
            lambda: read_answers(path, truth_file, threshold=1.5),
            ConfigError,
            ("threshold", "from 0 to 1", "1.5"),
        ),
    )
    assert read_answers(empty, truth_file).alarms == 0


@pytest.mark.parametrize(
    ("name", "value", "field"),
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
def test_a_changed_truth_file_is_refused_by_line_and_field(
    questions: QuestionFiles, tmp_path: Path, name: str, value: Any, field: str
) -> None:
    """Whatever a truth file holds, no other exception occurs."""
    truths = [dict(truth) for truth in questions.truth.values()]
    truths[1][name] = value
    changed_file = write_lines(tmp_path / "truth.jsonl", truths)
    answers = write_lines(tmp_path / "answers.jsonl", make_perfect_answers(questions))
    with pytest.raises(
        ResultsError,
        match=f"^{changed_file}:2: .* - at `{field}`; this is not a line of a truth file; give ",
    ):
        read_answers(answers, changed_file)


def test_the_command_writes_results_and_counts_unanswered_questions(
    questions: QuestionFiles, truth_file: Path, tmp_path: Path
) -> None:
    answers = write_lines(tmp_path / "answers.jsonl", make_perfect_answers(questions)[1:])
    out = tmp_path / "accident.json"
    result = invoke_command(
        "results", answers, "--truth", truth_file, "--out", out, "--method", "mine"
    )
    assert read_results(out).meta["method"] == "mine"
    assert "1 question without an answer" in result.stderr
