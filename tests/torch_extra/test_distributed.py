"""Several processes: merged counts, epochs, and one index for all of them."""

import json
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, ignore_patterns
from typing import Any

import pytest
import torch
from support.distributed_ranks import RANKS, filled_evaluators, run_ranks, write_rank_outputs
from support.expected_errors import assert_raises
from torch_extra.compared import are_identical

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import MotionEvaluator
from deepaccident_devkit.training.torch import (
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    merged_evaluator,
)

OutputReader = Callable[[str], list[Any]]
"""Returns the outputs of one name, in the order of ranks."""


def test_one_process_merges_only_its_own_evaluators() -> None:
    evaluator = MotionEvaluator()
    merged = merged_evaluator(evaluator)
    assert merged is not evaluator
    assert merged.settings == evaluator.settings

    assert_raises(
        (lambda: merged_evaluator(0.5), EvaluationError, ("MotionEvaluator()", "rank 0 has 0.5"))
    )


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """An odd number of samples, so that one rank has more than the other."""
    all_tokens = [record["token"] for record in da_motion.sample]
    ego_tokens = [token for token in all_tokens if token.endswith("ego_vehicle/015")]
    other_tokens = [token for token in all_tokens if token.endswith("other_vehicle/020")]
    return ego_tokens + other_tokens[:1]


@pytest.fixture(scope="module")
def read_outputs(
    da_motion: DeepAccident,
    tokens: list[str],
    release_root_b: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> OutputReader:
    """A reader of the files that `write_rank_outputs` writes."""
    folder = tmp_path_factory.mktemp("ranks")
    root = copytree(release_root_b, folder / "release", ignore=ignore_patterns(".deepaccident"))
    run_ranks(write_rank_outputs, folder, da_motion, tokens, root)

    def read(name: str) -> list[Any]:
        paths = [folder / f"{name}_{rank}.json" for rank in range(RANKS)]
        return [json.loads(path.read_text()) for path in paths]

    return read


@pytest.mark.slow
class TestTwoProcesses:
    def test_ranks_have_the_counts_of_one_process(
        self, read_outputs: OutputReader, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
    ) -> None:
        for evaluator in filled_evaluators(da_motion, tokens):
            path = evaluator.save(tmp_path / "one_process.json")
            counts = json.loads(path.read_text())
            assert read_outputs(type(evaluator).__name__) == [counts] * RANKS

    def test_ranks_refuse_other_settings(self, read_outputs: OutputReader) -> None:
        for error in read_outputs("merge_error"):
            assert "evaluate both with the same settings" in error

    def test_ranks_draw_their_own_augmentations_each_epoch(
        self, read_outputs: OutputReader, da_motion: DeepAccident, tokens: list[str]
    ) -> None:
        data = V2XDataset(
            da_motion,
            tokens,
            V2XConfig(points=False, augmentation=RandomAugmentation()),
        )
        ranks = read_outputs("augmentations")
        for epoch in range(2):
            data.set_epoch(epoch)
            lists = ranks[0][epoch] | ranks[1][epoch]
            matrices = {token: torch.tensor(rows) for token, rows in lists.items()}
            assert are_identical(
                matrices,
                {item["token"]: item["augmentation"] for item in data},
            )
            assert len({str(matrix) for matrix in matrices.values()}) == len(tokens)

        assert ranks[0][0] != ranks[0][1]

    def test_ranks_make_one_index(self, read_outputs: OutputReader) -> None:
        assert len(set(read_outputs("tables"))) == 1
