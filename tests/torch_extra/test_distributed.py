"""Several processes: their counts together, epochs, and one index for all."""

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, ignore_patterns
from typing import Any

import pytest
import torch
from ranks import RANKS, counted, everything, run_ranks
from refusals import assert_refused
from torch_extra.compared import same

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import MotionEvaluator
from deepaccident_devkit.training.torch import (
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    merged_evaluator,
)

Outcome = Callable[[str], list[Any]]


def test_alone_one_process_merges_its_own_and_only_evaluators() -> None:
    evaluator = MotionEvaluator()
    merged = merged_evaluator(evaluator)
    assert (merged is evaluator, merged.settings) == (False, evaluator.settings)
    assert_refused(
        (lambda: merged_evaluator(0.5), EvaluationError, ("MotionEvaluator()", "rank 0 has 0.5"))
    )


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """An odd number, so that ranks have different numbers."""
    return [
        record["token"]
        for record in da_motion.sample
        if record["token"].endswith("ego_vehicle/015")
    ] + [
        record["token"]
        for record in da_motion.sample
        if record["token"].endswith("other_vehicle/020")
    ][:1]


@pytest.fixture(scope="module")
def outcome(
    da_motion: DeepAccident,
    tokens: list[str],
    release_root_b: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Outcome:
    """What `ranks.everything` found, by rank."""
    folder = tmp_path_factory.mktemp("ranks")
    root = copytree(release_root_b, folder / "release", ignore=ignore_patterns(".deepaccident"))
    run_ranks(everything, folder, da_motion, tokens, root)

    def read(what: str) -> list[Any]:
        return [json.loads((folder / f"{what}_{rank}.json").read_text()) for rank in range(RANKS)]

    return read


@pytest.mark.slow
class TestTwoProcesses:
    """One run for all, since each process takes seconds to start."""

    def test_all_have_the_counts_of_one_process(
        self, outcome: Outcome, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
    ) -> None:
        for alone in counted(da_motion, tokens):
            saved = json.loads(alone.save(tmp_path / "alone.json").read_text())
            assert outcome(type(alone).__name__) == [saved] * RANKS

    def test_all_refuse_other_settings(self, outcome: Outcome) -> None:
        assert all("evaluate both with the same settings" in error for error in outcome("refused"))

    def test_they_draw_their_own_augmentations_each_epoch(
        self, outcome: Outcome, da_motion: DeepAccident, tokens: list[str]
    ) -> None:
        data = V2XDataset(
            da_motion, tokens, V2XConfig(points=False, augmentation=RandomAugmentation())
        )
        ranks = outcome("trained")
        for epoch in range(2):
            data.set_epoch(epoch)
            together = {
                token: torch.tensor(matrix)
                for rank in ranks
                for token, matrix in rank[epoch].items()
            }
            assert same(together, {item["token"]: item["augmentation"] for item in data})
            assert len({str(matrix) for matrix in together.values()}) == len(tokens)
        assert ranks[0][0] != ranks[0][1]

    def test_they_make_one_index(self, outcome: Outcome) -> None:
        assert len(set(outcome("opened"))) == 1
