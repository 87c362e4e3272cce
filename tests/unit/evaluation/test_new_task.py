"""A new task: a class and its name in `TASKS` are all that results, bundles and reports need."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
from support.evaluation_runs import stored_run

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import DetectedBoxes, Evaluator
from deepaccident_devkit.evaluation.evaluator import Counts, ratio, total
from deepaccident_devkit.evaluation.runs import (
    compare_bundles,
    evaluate_results,
    read_bundle,
    sample_rows,
    save_run,
)
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.runs.verification import verify_bundle
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.render.evaluation import save_report


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentCountResult(TaskResult):
    """The number of predicted agents for each true one."""

    rows: ClassVar[tuple[Row, ...]] = (Row("predicted_share", "share", "neither"),)
    predicted_share: float
    samples: int


@dataclass(frozen=True)
class AgentCountRules:
    """Rules that choose the predictions to count."""

    min_score: float = 0.0


class AgentCountEvaluator(Evaluator[AgentCountResult]):
    """An evaluator that counts predicted and true agents."""

    task = "agent_count"
    description = "Evaluate how many agents are predicted."
    result_kinds: ClassVar[tuple[str, ...]] = ("detection",)
    protocols: ClassVar[dict[str, Any]] = {
        "all": AgentCountRules(),
        "sure": AgentCountRules(min_score=0.5),
    }
    result_class = AgentCountResult

    def truth(self, dataset: Any, token: str, /, *_unused: Any) -> tuple[int]:
        return (len(dataset.boxes(token)),)

    def update(self, token: str, prediction: DetectedBoxes, agents: int) -> None:
        predicted = int((prediction.scores >= self.protocol.min_score).sum())
        self.add(token, {"predicted": predicted, "agents": agents})

    def result_of(self, counts: Collection[Counts]) -> AgentCountResult:
        share = ratio(total(counts, "predicted"), total(counts, "agents"))
        return AgentCountResult(predicted_share=share, samples=len(counts))


def test_a_new_task_is_a_class_and_its_name(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    detection = EvaluationSetup(task="detection", protocol="paper")
    _, results = stored_run(da_motion, detection, tmp_path / "results")
    monkeypatch.setitem(TASKS, "agent_count", AgentCountEvaluator)

    shares = {}
    for protocol in AgentCountEvaluator.protocols:
        setup = EvaluationSetup(task="agent_count", protocol=protocol)
        run = evaluate_results(da_motion, results, setup, "train", workers=1).broken_down()
        save_our_report = partial(save_report, run, dataset=da_motion, results=results)
        bundle = save_run(run, tmp_path / protocol, extras=[save_our_report])
        share = run.result.predicted_share
        shares[protocol] = share

        (headline,) = read_bundle(bundle).summary["headlines"]
        assert (headline["name"], headline["value"]) == ("predicted_share", share)
        assert {row["predicted_share"] is None for row in sample_rows(run)} == {False}
        verification = verify_bundle(bundle, da_motion, results=results, workers=1)
        assert verification.differences == ()

    assert 0 < shares["sure"] < shares["all"] < 1
    assert compare_bundles(tmp_path / "all", tmp_path / "all").numbers
