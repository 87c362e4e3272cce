"""The same question asked of many scenarios, a record each: here, on other processes, or in shards."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.files import writable_folder, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.parallel import Places, Shard, ShardFiles, check_whole, run_batch
from deepaccident_devkit.safety.accidents import Skipped

if TYPE_CHECKING:
    from concurrent.futures import Executor

Record = dict[str, Any]
"""What is said of one scenario, as JSON holds it."""
_NOTHING: Final = "nothing"
_RECORD: Final = "record"
_SKIPPED: Final = "skipped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Found(ShortRepr):
    """The answers of many scenarios.

    Attributes:
        records: of those that have one, in the order of the scenarios.
        skipped: those that lack what the question needs, and why.
        without: how many the question does not concern, such as recordings without a collision.
    """

    records: tuple[Record, ...]
    skipped: tuple[Skipped, ...]
    without: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey(ShortRepr):
    """A question to scenarios.

    Attributes:
        dataset: the release.
        ask: an importable function that gives a scenario's record from the dataset and the token; None where the
            question does not concern it. NotAvailableError means that the scenario lacks what is needed.
        scenarios: tokens.
        settings: all else that decides the answers, in words; other settings have other shards.
    """

    dataset: Dataset
    ask: Callable[[Dataset, str], Record | None]
    scenarios: Sequence[str]
    settings: str

    def run(
        self,
        *,
        label: str = "scenarios",
        workers: int | None = None,
        executor: Executor | None = None,
        progress: bool = False,
    ) -> Found:
        """Ask all scenarios.

        Args:
            label: text of the progress bar.
            workers: processes.
            executor: any executor of `concurrent.futures` to run on, in place of own workers.
            progress: whether to show a bar.

        Raises:
            TokenError: something is no scenario of the release.
            WorkerError: a worker was killed, or cannot do the work.
        """
        how: Mapping[str, Any] = {"label": label, "workers": workers, "executor": executor, "progress": progress}
        return _found(self._asked(self.scenarios, **how).values())

    def run_shard(self, shard: Shard, out: str | os.PathLike[str], **how: Any) -> int:
        """Ask a part of the scenarios and keep the answers beside `out`; returns how many the part has.

        `how` is as of `run`.

        Raises:
            ConfigError: nothing can be written beside `out`.
            TokenError, WorkerError: as of `run`.
        """
        files, own = self._files(out), shard.of(self.scenarios)
        writable_folder(files.folder)
        if _read(files.path(shard)).keys() != set(own):
            text = json.dumps(self._asked(own, **how))
            write_bytes(files.path(shard), text.encode())
        return len(own)

    def merged(self, out: str | os.PathLike[str]) -> Found:
        """What `run` gives, from the files of all shards; raises UnfinishedError if some are missing."""
        files = self._files(out)
        answers = {token: answer for path in files.found() for token, answer in _read(path).items()}
        check_whole(list(self.scenarios), answers.keys(), files.folder)
        return _found(answers[token] for token in self.scenarios)

    def remove_shards(self, out: str | os.PathLike[str]) -> None:
        """Remove what shards kept, once the whole is written."""
        self._files(out).remove()

    def _asked(self, scenarios: Sequence[str], **how: Any) -> dict[str, Any]:
        work = partial(_answer, self.dataset, self.ask)
        answers = run_batch(work, scenarios, places=Places(reads=self.dataset.places), **how)
        return dict(zip(scenarios, answers, strict=True))

    def _files(self, out: str | os.PathLike[str]) -> ShardFiles:
        text = repr((__version__, self.dataset.tables_folder.name, self.settings, tuple(self.scenarios)))
        return ShardFiles(Path(out).absolute(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest(), ".json")


def _answer(dataset: Dataset, ask: Callable[[Dataset, str], Record | None], scenario: str) -> tuple[str, Any]:
    try:
        record = ask(dataset, scenario)
    except NotAvailableError as error:
        return _SKIPPED, asdict(Skipped(scenario=scenario, reason=str(error)))
    return (_NOTHING, None) if record is None else (_RECORD, record)


def _found(answers: Any) -> Found:
    of_kind: dict[str, list[Any]] = {kind: [] for kind in (_RECORD, _SKIPPED, _NOTHING)}
    for kind, content in answers:
        of_kind[kind].append(content)
    return Found(
        records=tuple(of_kind[_RECORD]),
        skipped=tuple(Skipped(**each) for each in of_kind[_SKIPPED]),
        without=len(of_kind[_NOTHING]),
    )


def _read(path: Path) -> dict[str, Any]:
    """The answers in a file; none if it is not there or damaged."""
    try:
        content = parsed_json(path.read_bytes(), constants=True)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
