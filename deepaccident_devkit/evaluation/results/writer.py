"""`ResultsWriter`: writes predictions of many samples into a results file, completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results.entries import EntryWriter
from deepaccident_devkit.evaluation.results.header import ContentError, MotionForm, check_token, json_meta
from deepaccident_devkit.evaluation.results.records import FORMAT, FORMAT_VERSION, ResultsTask, Stored
from deepaccident_devkit.evaluation.results.shards import ShardWriter
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.files import replacing, replacing_folder
from deepaccident_devkit.support.text import choice, path_of


class ResultsWriter:
    """Writes results that `read_results` reads; used in a `with` statement.

    The file, or for motion the folder, appears when the block ends well; after an exception there is nothing. Memory
    does not grow with the samples, and the same predictions give the same bytes.

        with ResultsWriter("results/motion", "motion", meta={"method": "mine"}) as writer:
            for token in tokens:
                writer.add(token, MotionOutput.from_arrays(*model(token), grid=grid))
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        task: ResultsTask,
        *,
        meta: Mapping[str, Any] | None = None,
        grid: BevGrid | None = None,
        step: float = 0.5,
        labels: str | None = "released",
        store: Stored = "instances",
    ) -> None:
        """Prepare to write; touches nothing.

        Args:
            path: a file that is not there yet; for motion a folder that is not there, or empty.
            task: `motion`, `accident` or `detection`.
            meta: what readers should know: method, training, author; as JSON holds it.
            grid: of motion, that of all predictions; None takes the first one's.
            step: of motion, seconds between two frames.
            labels: of motion, the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from, which it is
                compared with; None if it is not known.
            store: of motion, `instances` keeps instance maps, some 30 KB a sample of five predictions; heads are
                post-processed as the released evaluation of motion does (docs/released_code.md, Post-processing). The
                released accident evaluation does that in its own way, and from instance maps its numbers differ
                slightly. `heads` keeps the maps of the model as they are: 34 MB a sample of six predictions.

        Raises:
            ChoiceError: no such task.
            ResultsError: a value that cannot be written, or something stands at `path`.
        """
        self.task = choice("task", task, get_args(ResultsTask))
        self.path = path_of(path).absolute()
        try:
            told = json_meta({} if meta is None else meta)
        except ContentError as error:
            raise ResultsError(str(error)) from error
        self._header = {"format": FORMAT, "version": FORMAT_VERSION, "task": self.task, "meta": told}
        form = MotionForm(stored=store, grid=grid or BevGrid(), predictions=1, frames=1, step=step, labels=labels)
        self._motion: dict[str, Any] = {"grid": grid, "step": form.step, "labels": form.labels, "store": form.stored}
        self._check_free()
        self._tokens: set[str] = set()
        self._stack = ExitStack()
        self._body: EntryWriter | ShardWriter | None = None

    def __repr__(self) -> str:
        """Its task and path, and how many samples it has written."""
        return f"ResultsWriter({self.task} to {self.path}: {len(self._tokens):,} samples)"

    def __enter__(self) -> ResultsWriter:
        """Begin beside the path; raises ResultsError if nothing can be written there."""
        self._check_free()
        with _told(self.path), ExitStack() as stack:
            if self.task == "motion":
                folder = stack.enter_context(replacing_folder(self.path))
                self._body = ShardWriter(folder, self._header, **self._motion)
            else:
                self._body = EntryWriter(stack.enter_context(replacing(self.path)), self._header)
            stack.callback(self._body.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the results in their place, or after an exception remove what was written."""
        body, self._body = self._body, None
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with _told(self.path), self._stack:
            if body is None:
                raise ResultsError("a prediction could not be written, so that none is kept; write all of them again")
            body.finish()

    def add(self, token: str, prediction: MotionOutput | Iterable[Accident] | DetectedBoxes) -> None:
        """Write the prediction of a sample.

        Args:
            token: of the sample; each one once.
            prediction: of motion a MotionOutput, all of one grid and number of frames; of accidents those that are
                foreseen, [] for none; of detection the boxes, in the world frame.

        Raises:
            ResultsError: the prediction is of another kind, grid or frame, the sample was added before, or nothing can
                be written; the message begins with path and token.
        """
        if self._body is None:
            raise ResultsError(f"{self.path}: is not open; add predictions inside `with ResultsWriter(…) as writer:`")
        try:
            check_token(token)
            if token in self._tokens:
                raise ResultsError("was added before; give each sample one prediction")
            self._body.add(token, prediction)
        except (ContentError, ResultsError) as error:
            raise ResultsError(f"{self.path}: {token}: {error}") from error
        except OSError as error:
            self._body = None
            raise _unwritten(self.path, error) from error
        self._tokens.add(token)

    def _check_free(self) -> None:
        with _told(self.path):
            empty = self.task == "motion" and self.path.is_dir() and not any(self.path.iterdir())
            if not empty and (self.path.exists() or self.path.is_symlink()):
                raise ResultsError(f"{self.path}: is there already; choose another path, or remove it")


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Raise ResultsError that names the results for an error of the system."""
    try:
        yield
    except ResultsError as error:
        text = str(error)
        raise ResultsError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: OSError) -> ResultsError:
    return ResultsError(f"{path}: results cannot be written ({error}); make room there, or choose another path")
