"""`StudyInParts`: the study of V2X on many machines, or after an interruption.

A few samples' counts are a file at a time, beside the place of the study, until all are there.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit._version import __version__
from deepaccident_devkit.baselines.conditions import Condition
from deepaccident_devkit.baselines.counting import BATCH, CountJob, Evaluators, count_samples
from deepaccident_devkit.baselines.predict_results import samples_by_scenario
from deepaccident_devkit.baselines.study import PlannedStudy
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import V2XStudy
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.files import path_of, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.parallel import (
    MERGE,
    Part,
    Places,
    Shard,
    ShardFiles,
    Tried,
    check_failures,
    check_whole,
    mine,
    part_of,
    run_batch,
)
from deepaccident_devkit.reading import fault_text, read_bytes
from deepaccident_devkit.release.fingerprints import digest_of

if TYPE_CHECKING:
    from concurrent.futures import Executor


class StudyInParts:
    """A study of V2X whose counts stay beside `out` until `remove`: what was counted is not counted again.

    Shards of it may be counted anywhere, in any order, and several times:

        StudyInParts(da, "study").count("3/8")  # in each of eight jobs
        StudyInParts(da, "study").result()  # afterwards
    """

    def __init__(
        self,
        dataset: Dataset,
        out: str | os.PathLike[str],
        split: str | os.PathLike[str] = "val",
        config: StudyConfig | None = None,
    ) -> None:
        """Plan a study.

        Args:
            dataset: the release.
            out: where the study will be; nothing is written into it here.
            split: `val`, … or a split file.
            config: the settings; None for the paper's.

        Raises:
            ChoiceError: no such split.
            NotAvailableError: the release has nothing to compare.
        """
        self._planned = planned = PlannedStudy.of(dataset, split, config or StudyConfig())
        decisive = {
            "samples": {str(horizon): tokens for horizon, tokens in planned.samples.tokens.items()},
            "conditions": sorted({repr(each) for each in chain.from_iterable(planned.conditions.values())}),
            "counting": [planned.config.model, planned.config.protocol, planned.config.seeds],
            "release": [dataset.version, dataset.tables_folder.name],
            "devkit": __version__,
        }
        self._files = ShardFiles(path_of(out).absolute(), digest_of(decisive), ".json")

    def __repr__(self) -> str:
        """How many samples it is of, and its place."""
        return f"StudyInParts({len(self._planned.conditions):,} samples, {self._files.out})"

    def count(
        self,
        part: Part | str = None,
        *,
        workers: int | None = None,
        executor: Executor | None = None,
        progress: bool = False,
    ) -> int:
        """Count what is not counted yet of the samples, or of a part; returns how many samples it is of.

        Args:
            part: `3/8` for the third of eight parts; None for all; `merge` for none.
            workers: processes; None takes what the work is worth.
            executor: any executor of `concurrent.futures` to run on, in place of own workers.
            progress: whether to show a bar.

        Raises:
            ChoiceError: no such part.
            SomeFailedError: some samples cannot be counted; the others are.
            WorkerError: a worker was killed, or cannot do the work.
        """
        part = part_of(part)
        if part == MERGE:
            return 0
        own = mine(part, self._jobs())
        results = run_batch(
            Tried(_count),
            own,
            workers=workers,
            executor=executor,
            label="samples",
            progress=progress,
            places=Places(reads=self._planned.counting.dataset.places, writes=(self._files.folder,)),
        )
        check_failures(
            [(job.tokens[0], result) for job, result in zip(own, results, strict=True)], str(self._files.out)
        )
        return sum(len(job.tokens) for job in own)

    def result(self) -> V2XStudy:
        """The study, of all counts.

        Raises:
            UnfinishedError: some samples are not counted.
            EvaluationError: their counts cannot be read.
        """
        jobs = self._jobs()
        there = chain.from_iterable(job.tokens for job in jobs if job.path.exists())
        check_whole(list(chain.from_iterable(job.tokens for job in jobs)), set(there), self._files.out)
        result: dict[Condition, Evaluators] = {}
        for job in jobs:
            _take(job, self._planned.config.protocol, result)
        return self._planned.study(result)

    def remove(self) -> None:
        """Remove the counts, once the study is written."""
        self._files.remove()

    def _jobs(self) -> list[_Job]:
        conditions = self._planned.conditions
        scenarios = samples_by_scenario(sorted(conditions))
        batches = [each[at : at + BATCH] for each in scenarios for at in range(0, len(each), BATCH)]
        return [
            _Job(
                CountJob(self._planned.counting, tuple((token, conditions[token]) for token in batch)),
                self._files.path(Shard(number, len(batches))),
            )
            for number, batch in enumerate(batches, start=1)
        ]


@dataclass(frozen=True, slots=True)
class _Job:
    """Samples to count, and the file of their counts."""

    samples: CountJob
    path: Path

    @property
    def tokens(self) -> Sequence[str]:
        return [token for token, _ in self.samples.samples]


def _count(job: _Job) -> None:
    """Write the counts of samples, unless they are there."""
    if not job.path.exists():
        found = count_samples(job.samples)
        stored = [{"condition": asdict(each), "counts": counts.as_dict()} for each, counts in found.items()]
        write_bytes(job.path, json.dumps(stored).encode())


def _take(job: _Job, protocol: str, result: dict[Condition, Evaluators]) -> None:
    """Add the counts of a file to the evaluators of conditions; raises EvaluationError if they cannot be read."""
    wanted = set(chain.from_iterable(conditions for _, conditions in job.samples.samples))
    try:
        stored = {
            Condition(**each["condition"]): each["counts"]
            for each in parsed_json(read_bytes(job.path, "results"), constants=True)
        }
        if stored.keys() != wanted:
            raise ValueError(f"has {len(stored)} conditions, not {len(wanted)}")
        for condition, counts in stored.items():
            result.setdefault(condition, Evaluators.of(protocol)).add(counts)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise EvaluationError(
            f"{job.path}: no saved counts ({fault_text(error)}); remove it, and count again"
        ) from error
