"""Where an evaluation that is not finished keeps its counts, so that it goes on when it is called again."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.setups import EvaluationSetup
from deepaccident_devkit.release.fingerprints import digest_of

_ENDING: Final = ".counts.json"


def checkpoint_path(
    out: str | os.PathLike[str],
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
    purpose: str = "evaluation",
) -> Path:
    """The file beside `out` that such a run saves its counts to.

    Its name is a digest of all that decides the counts: another setup, other samples, other predictions, other labels
    and another devkit have another file, and so never go on with these counts.

    Args:
        out: the folder that the finished evaluation goes to.
        setup: task and rules.
        tokens: the samples.
        fingerprints: of the predictions and of the labels.
        purpose: what is counted, where that is something else than the evaluation itself.
    """
    name = digest_of(
        {
            "devkit": __version__,
            "setup": setup.as_dict(),
            "tokens": sorted(tokens),
            "fingerprints": dict(fingerprints),
            "purpose": purpose,
        }
    )
    return _folder(out) / f"{name}{_ENDING}"


def explanation_checkpoint(run: EvaluationRun, out: str | os.PathLike[str]) -> Path:
    """The same file for the explanation of a run (`explain`), which takes longer than the run itself."""
    fingerprints = {"results": run.results.fingerprint, "release": run.release.fingerprint}
    return checkpoint_path(out, run.setup, run.evaluator.tokens, fingerprints, "explanation")


def drop_if_damaged(path: Path, evaluator: Evaluator[Any]) -> None:
    """Remove a file that no counts can be taken from: it costs time, and nothing else."""
    if path.exists():
        try:
            evaluator.fresh().resume(path)
        except EvaluationError:
            path.unlink()


def remove_checkpoints(out: str | os.PathLike[str]) -> None:
    """Remove all such files beside `out`, once what they were for is written."""
    folder = _folder(out)
    for path in folder.glob(f"*{_ENDING}"):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # something else lies there
        folder.rmdir()


def _folder(out: str | os.PathLike[str]) -> Path:
    target = Path(out).expanduser()
    return target.with_name(f"{target.absolute().name}.unfinished")
