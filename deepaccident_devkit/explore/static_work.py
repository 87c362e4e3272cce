"""What workers do for the pages of an export: a scenario's thumbnail, its replay, and what its page says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.explore.pages.scenario import PARTS, part_context
from deepaccident_devkit.explore.pages.scenarios import SLOW
from deepaccident_devkit.explore.scenarios import accident_columns
from deepaccident_devkit.explore.thumbnails import thumbnail
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.pages import rendered
from deepaccident_devkit.render.replay import recording_of, tried_replay
from deepaccident_devkit.render.replay.facts import facts
from deepaccident_devkit.selection.fields import measures_of_moving_pairs

REPLAY: Final = "replay.html"
THUMBNAIL: Final = "thumbnail.jpg"


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """A scenario of an export.

    Attributes:
        token: of the scenario.
        folder: its own, relative to that of the export.
        predictions: names and results of the models that tell of it.
    """

    token: str
    folder: str
    predictions: tuple[tuple[str, Results], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """What a scenario's page says; its thumbnail and replay are files.

    Attributes:
        facts: names and values.
        parts: of `PARTS`, as HTML.
        measures: of `SLOW`.
        model: whose predictions the replay shows; empty for none.
        reason: why there is no replay; empty if there is one.
    """

    facts: Sequence[Sequence[str]]
    parts: Mapping[str, str]
    measures: Mapping[str, Any]
    model: str
    reason: str


def tell(dataset: Dataset, folder: Path, work: Work) -> Told:
    """Write a scenario's files below the folder of the export, and find what its page says."""
    record = dataset.scenario.get(work.token)
    own = folder / work.folder
    write_bytes(own / THUMBNAIL, thumbnail(dataset, record))
    measures = accident_columns(dataset, record) | measures_of_moving_pairs(interactions(dataset, record))
    model, reason = _make_replay(dataset, work, own / REPLAY)
    return Told(
        facts=facts(recording_of(dataset, work.token, None)),
        parts={name: _part(dataset, work.token, name) for name in PARTS},
        measures={name: measures[name] for name in SLOW},
        model=model,
        reason=_without_place(dataset, reason),
    )


def _make_replay(dataset: Dataset, work: Work, path: Path) -> tuple[str, str]:
    """Write a replay with the first predictions that can be shown; whose they are, and why there is no replay."""
    for name, prediction in work.predictions:
        if tried_replay(dataset, work.token, path, prediction=prediction) is None:
            return name, ""
    return "", tried_replay(dataset, work.token, path) or ""


def _part(dataset: Dataset, token: str, name: str) -> str:
    context = part_context(dataset, token, name)
    if "findings" in context:
        context["findings"] = [
            replace(each, where=_without_place(dataset, each.where), what=_without_place(dataset, each.what))
            for each in context["findings"]
        ]
    return rendered(f"parts/{name}.html", root="", static=True, frame_number=str, **context)


def _without_place(dataset: Dataset, text: str) -> str:
    """A text in which paths of the release's files begin in its folder: pages for others do not tell where it lies."""
    return text.replace(f"{dataset.dataroot}/", "")
