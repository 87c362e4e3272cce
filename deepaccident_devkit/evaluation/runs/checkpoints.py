"""Counts that are kept beside an evaluation until it is written: of a run that broke off, and of shards."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.files import path_of
from deepaccident_devkit.parallel import Shard, ShardFiles, unfinished_folder
from deepaccident_devkit.release.fingerprints import digest_of

_ENDING: Final = ".counts.json"
_OF_SHARD: Final = re.compile(rf"[0-9a-f]+\.([1-9]\d{{0,8}})-of-([1-9]\d{{0,8}}){re.escape(_ENDING)}", re.ASCII)


def checkpoint_path(
    out: str | os.PathLike[str],
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
    *,
    shard: Shard | None = None,
) -> Path:
    """The file beside `out` that such a run saves its counts to.

    Its name is a digest of all that affects the counts: another setup, other samples, other predictions, other labels
    and another devkit have another file, and so never go on with these counts.

    Args:
        out: the folder that the finished evaluation goes to.
        setup: task and rules.
        tokens: the samples.
        fingerprints: of the predictions and of the labels.
        shard: the part that the samples are of; None for all.
    """
    name = digest_of(
        {
            "devkit": __version__,
            "setup": setup.as_dict(),
            "tokens": sorted(tokens),
            "fingerprints": dict(fingerprints),
        }
    )
    files = ShardFiles(_absolute(out), name, _ENDING)
    return files.folder / f"{name}{_ENDING}" if shard is None else files.path(shard)


def stored_shards(out: str | os.PathLike[str]) -> list[Shard]:
    """The parts whose counts are beside `out`, of one evaluation or of several."""
    found = (_OF_SHARD.fullmatch(path.name) for path in ShardFiles(_absolute(out), "*", _ENDING).found())
    numbers = {(int(each[2]), int(each[1])) for each in found if each is not None}
    return [Shard(number, count) for count, number in sorted(numbers) if number <= count]


def whole_counts(path: Path, evaluator: Evaluator[Any]) -> Evaluator[Any] | None:
    """The counts in a file, if it is there; one from which none can be taken is removed: only time is lost."""
    if path.exists():
        try:
            return evaluator.fresh().resume(path)
        except EvaluationError:
            path.unlink()
    return None


def remove_checkpoints(out: str | os.PathLike[str]) -> None:
    """Remove all such files beside `out`, those of shards too, once what they were for is written."""
    folder = unfinished_folder(_absolute(out))
    for path in folder.glob(f"*{_ENDING}"):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # something else lies there
        folder.rmdir()


def _absolute(out: str | os.PathLike[str]) -> Path:
    return path_of(out).absolute()
