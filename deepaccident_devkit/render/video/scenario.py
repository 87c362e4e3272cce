"""`render_scenario_video`: the frames of a scenario, rendered in parallel, into one file."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.files import path_of
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.render.layers import Layer
from deepaccident_devkit.render.video.views import OwnView, Scene, names_at, views_of
from deepaccident_devkit.render.video.writers import check_target, write_video
from deepaccident_devkit.tables.tokens import frame_token
from deepaccident_devkit.v2x import Agents

if TYPE_CHECKING:
    from concurrent.futures import Executor


def render_scenario_video(  # noqa: PLR0913 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    scenario: RowArgument,
    path: str | os.PathLike[str],
    *,
    what: str | OwnView | Iterable[str | OwnView] = "frame",
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    frames: Collection[int] | slice | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: float = 10.0,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> Path:
    """Write a scenario as a video.

    The views are those of the `render_…` functions: `frame` (the agents' front cameras beside one view from above),
    `sample` (six cameras), `bev`, `visibility`, `visibility_matrix`, `calibration`, `labels` (motion labels as a
    trail), a camera by its channel, and `accident`: the countdown to the impact in five cameras, from above and in
    speeds. `frame`, `accident`, or two or three of the others side by side, fill a picture of 16 to 9.

    Args:
        dataset: the release.
        scenario: token or record.
        path: the file to write, by its suffix: `.mp4` (with the extra `video`), `.gif` or `.webp`. An earlier file is
            replaced when the new one is complete.
        what: a view by name, a function (dataset, frame record, figure) that renders one, or several side by side.
        agents: who is shown, or None for all that are there. Views of one agent (`sample`, `bev`, cameras, …) show the
            first one named, or the first one there; their boxes and points from above are of all of `agents`.
        layers: each view renders those of them that it has; None for the default of each view.
        frames: numbers of frames, from 1, in the order given; or a slice of the list of all frames; None for all.
        size: width and height, pixels; even numbers for MP4.
        fps: frames a second; the recordings have 10.
        workers: processes that render. None chooses by the amount of work, and only this process for functions of your
            own; with several processes these functions must be importable from a module.
        executor: any executor of `concurrent.futures` to render on, in place of own workers; it must be able to send
            functions of your own.
        progress: whether to show a bar.

    Returns:
        The path written.

    Raises:
        TokenError: no such scenario.
        ChoiceError: no such view, layer, agent, frame or kind of file, or the file cannot have this size or rate.
        NotAvailableError: an agent is not in this release, the sample has no label, or nobody collides and the view
            is `accident`.
        MissingExtraError: the file is an `.mp4`, and the extra `video` is not installed.
        WorkerError: a worker was killed, or cannot do the work.
    """
    target, (width, height) = path_of(path), size
    check_target(target, size=(width, height), fps=fps)
    views = views_of(what, layers)
    record = dataset.get("scenario", scenario)
    tokens = [frame_token(record["token"], number) for number in _numbers(frames, record["num_frames"])]
    names_at(dataset, tokens[0], agents)  # before any worker starts
    own = [view.own for view, _ in views if view.own is not None]
    scene = Scene(dataset=dataset, views=views, agents=agents, width=width, height=height)
    drawn = run_unordered(
        scene.picture,
        tokens,
        workers=_workers(own, workers),
        executor=executor,
        label="frames",
        progress=progress,
        places=Places(reads=dataset.places),
    )
    with closing(in_order(drawn)) as pictures:
        write_video(target, pictures, fps=fps)
    return target


def _numbers(frames: Collection[int] | slice | None, last: int) -> list[int]:
    """Frame numbers from 1; raises ChoiceError."""
    recorded = range(1, last + 1)
    if frames is None or isinstance(frames, slice):
        numbers = list(recorded[frames] if frames else recorded)
    else:
        numbers = list(frames)
    wrong = [number for number in numbers if number not in recorded]
    if wrong or not numbers:
        raise ChoiceError(f"frames: expected numbers from 1 to {last}, found {wrong[0] if wrong else 'none'}")
    return numbers


def _workers(own: Sequence[OwnView], workers: int | None) -> int | None:
    """How many processes render; raises ChoiceError if a function cannot be sent to them."""
    if not own or workers == 1:
        return workers
    if workers is None:
        return 1
    for function in own:
        name = getattr(function, "__qualname__", "<")
        if function.__module__ == "__main__" or "<" in name:
            raise ChoiceError(
                f"workers: {name} cannot be sent to other processes; put it into a module of its own, or pass workers=1"
            )
    return workers
