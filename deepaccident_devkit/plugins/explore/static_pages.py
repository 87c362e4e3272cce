"""`export_pages`: some scenarios as pages that are files, for a talk or a supplement: no server, no network."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from deepaccident_devkit.collisions import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.interactions.scenario import measures_of_moving_pairs
from deepaccident_devkit.plugins.explore.background import Jobs
from deepaccident_devkit.plugins.explore.choices import find_call, where_words
from deepaccident_devkit.plugins.explore.explorer import thumbnail
from deepaccident_devkit.plugins.explore.models import FORESEEN, Model, open_models
from deepaccident_devkit.plugins.explore.pages.release import SLOW, cell, entry
from deepaccident_devkit.plugins.explore.pages.responses import assets
from deepaccident_devkit.plugins.explore.pages.scenario import PARTS, part_context
from deepaccident_devkit.plugins.explore.scenarios import accident_fields
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.replay import recording_of, tried_replay
from deepaccident_devkit.render.replay.page import facts
from deepaccident_devkit.selection import find
from deepaccident_devkit.support.files import (
    plain_names,
    replacing_folder,
    temporary_path,
    writable_folder,
    write_bytes,
)
from deepaccident_devkit.support.pages import rendered
from deepaccident_devkit.support.parallel import Engine, Places, run_batch
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.tables.records import ScenarioRecord

# The file by which an export knows the folder of an earlier one: it names all files that were written.
MARK: Final = ".deepaccident_pages"
_HEAD: Final = "DeepAccident pages"
_REPLAY_FILE: Final = "replay.html"
THUMBNAIL: Final = "thumbnail.jpg"
# Scenarios of an export: a replay takes some seconds and up to 15 MB.
MOST_SCENARIOS: Final = 50
INDEX: Final = "index.html"
_STATIC: Final = "static"
_ASSETS: Final = ("pages.css", "explore.css", "keys.js", "sorting.js")
# Nothing is loaded but the files of the export, from a disk or from a server.
_POLICY: Final = (
    "default-src 'none'; script-src 'self' file:; style-src 'self' file:; img-src 'self' file: data:; "
    "frame-src 'self' file:; base-uri 'none'; form-action 'none'"
)


def target_folder(folder: str | os.PathLike[str]) -> Path:
    """The real path of a folder for an export; raises ConfigError if it cannot be written to, or holds other files."""
    target = path_of(folder, "expected a folder to write to").resolve()
    writable_folder(target.parent)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target}: is a file; name a folder that does not exist yet")
    others = sorted(set(_files(target)) - set(_earlier(target)))
    if others:
        raise ConfigError(
            f"{target}: holds {others[0]}, which no export wrote; name a folder that is empty, or does not exist yet"
        )
    return target


@contextmanager
def exported(target: Path) -> Iterator[Path]:
    """Yield a new folder; if the block succeeds it takes the place of the target, and of an earlier export there."""
    aside = temporary_path(target)
    try:
        with replacing_folder(target) as made:
            yield made
            write_bytes(
                made / MARK,
                "".join(f"{line}\n" for line in (_HEAD, *sorted(_files(made)))).encode(),
            )
            if target.is_dir() and any(target.iterdir()):
                target.rename(aside)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _files(folder: Path) -> Iterator[str]:
    """All files and links below a folder, relative to it."""
    for path, folders, files in os.walk(folder):
        links = [name for name in folders if Path(path, name).is_symlink()]
        yield from (Path(path, name).relative_to(folder).as_posix() for name in (*links, *files))


def _earlier(folder: Path) -> list[str]:
    """The files that an earlier export wrote into a folder; none if there was none."""
    mark = folder / MARK
    if not mark.is_file() or mark.is_symlink():
        return []
    head, *names = read_bytes(mark, "index").decode(errors="replace").splitlines()
    return [*names, MARK] if head == _HEAD else []


@dataclass(frozen=True, slots=True, kw_only=True)
class _ExportedScenario:
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


def tell(dataset: Dataset, folder: Path, work: _ExportedScenario) -> Told:
    """Write a scenario's files below the folder of the export, and find what its page says."""
    record = dataset.scenario.get(work.token)
    own = folder / work.folder
    write_bytes(own / THUMBNAIL, thumbnail(dataset, record))
    measures = accident_fields(dataset, record) | measures_of_moving_pairs(
        interactions(dataset, record)
    )
    model, reason = _make_replay(dataset, work, own / _REPLAY_FILE)
    return Told(
        facts=facts(recording_of(dataset, work.token, None)),
        parts={name: _part(dataset, work.token, name) for name in PARTS},
        measures={name: measures[name] for name in SLOW},
        model=model,
        reason=_without_place(dataset, reason),
    )


def _make_replay(dataset: Dataset, work: _ExportedScenario, path: Path) -> tuple[str, str]:
    """Write a replay with the first predictions that can be shown; whose they are, and why there is no replay."""
    for name, prediction in work.predictions:
        if tried_replay(dataset, work.token, path, prediction=prediction) is None:
            return name, ""
    return "", tried_replay(dataset, work.token, path) or ""


def _part(dataset: Dataset, token: str, name: str) -> str:
    context = part_context(dataset, token, name)
    if "findings" in context:
        context["findings"] = [
            replace(
                each,
                where=_without_place(dataset, each.where),
                what=_without_place(dataset, each.what),
            )
            for each in context["findings"]
        ]
    return rendered(f"parts/{name}.html", root="", static=True, frame_number=str, **context)


def _without_place(dataset: Dataset, text: str) -> str:
    """A text in which paths of the release's files begin in its folder: pages for others do not tell where it lies."""
    return text.replace(f"{dataset.dataroot}/", "")


def export_pages(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    *,
    where: Sequence[str] = (),
    bundles: Iterable[Path] = (),
    results: Iterable[Path] = (),
    scenarios: Iterable[RowArgument] | None = None,
    **how: Unpack[Engine],
) -> Path:
    """Write pages of some scenarios as files: a list, and for each a replay, its story, pairs, lead times and findings.

    They work from a disk, without a server and a network, and from any web server. Nothing in them tells where the
    release lies. The same call gives the same bytes.

    Args:
        dataset: the release.
        folder: where; new, empty, or an earlier export, which is replaced.
        where: filters as of `find`, all of which hold.
        bundles: folders that `save_run` wrote with their results.
        results: files or folders of results. A replay shows the predictions of the first ones that tell of the
            scenario, those of bundles before others.
        scenarios: tokens or records, of which those that match are written, in this order; None for all.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Returns:
        The first page, `index.html`.

    Raises:
        ConfigError: more than 50 scenarios match; or the folder cannot be written to, or holds other files.
        NotAvailableError: no scenario matches.
        FieldError, ChoiceError, TokenError: there is no such filter or scenario.
        ResultsError: bundles or results cannot be read.
        WorkerError: as `parallel.Engine` says.

    Examples:
        >>> export_pages(
        ...     da, "night", where=["time_of_day=Night", "collision=true"]
        ... )  # doctest: +SKIP
    """
    given = (
        None
        if scenarios is None
        else [dataset.get("scenario", each)["token"] for each in scenarios]
    )
    records = _chosen(dataset, where, given)
    target = target_folder(folder)
    models = open_models(bundles, results, Jobs())
    filters = [*where, *([] if given is None else [f"token={','.join(given)}"])]
    with exported(target) as made:
        _Pages(dataset, made, records, models).write(filters, **how)
    return target / INDEX


def _chosen(
    dataset: Dataset, where: Sequence[str], given: Sequence[str] | None
) -> list[ScenarioRecord]:
    """The scenarios to write; raises ConfigError if they are too many."""
    records = find(dataset, *where)
    if given is not None:
        by_token = {record["token"]: record for record in records}
        records = [by_token[token] for token in dict.fromkeys(given) if token in by_token]
    if not records:
        raise NotAvailableError(
            "no scenario matches, so there is nothing to export; change --where"
        )
    if len(records) > MOST_SCENARIOS:
        raise ConfigError(
            f"{len(records)} scenarios match, and at most {MOST_SCENARIOS} are exported; narrow --where"
        )
    return records


def _folders(records: Sequence[ScenarioRecord]) -> dict[str, str]:
    """Scenario → its folder, `TYPE/NAME` in letters that all file systems and addresses know."""
    types = plain_names(
        dict.fromkeys(record["scenario_type"] for record in records), taken=(_STATIC, INDEX, MARK)
    )
    names = {
        kind: plain_names(record["name"] for record in records if record["scenario_type"] == kind)
        for kind in types
    }
    return {
        record[
            "token"
        ]: f"{types[record['scenario_type']]}/{names[record['scenario_type']][record['name']]}"
        for record in records
    }


class _Pages:
    """The pages of an export that is being written into a folder."""

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        records: Sequence[ScenarioRecord],
        models: Mapping[str, Model],
    ) -> None:
        self._dataset, self._folder, self._records, self._models = dataset, folder, records, models
        self._names = _folders(records)

    def write(self, filters: Sequence[str], **how: Unpack[Engine]) -> None:
        """Write all pages of scenarios that were found by filters, and what they show; `how` as of `export_pages`."""
        items = [
            _ExportedScenario(token=token, folder=name, predictions=self._predictions(token))
            for token, name in self._names.items()
        ]
        places = Places(reads=self._dataset.places, writes=(self._folder,))
        work = partial(tell, self._dataset, self._folder)
        told = run_batch(work, items, label="pages of scenarios", places=places, **how)
        for name in _ASSETS:
            write_bytes(self._folder / _STATIC / name, assets()[name].encode())
        for place, each in enumerate(told):
            self._write_scenario(place, each)
        self._write_index(filters, told)

    def _predictions(self, token: str) -> tuple[tuple[str, Results], ...]:
        """Those that a replay of the scenario can show."""
        return tuple(
            (name, model.results)
            for name, model in self._models.items()
            if model.results is not None
            and model.results.task in FORESEEN
            and token in model.scenarios
        )

    def _write_index(self, filters: Sequence[str], told: Sequence[Told]) -> None:
        self._write_page(
            INDEX,
            "written_list.html",
            "./",
            entries=[
                entry(record, {name: cell(value) for name, value in each.measures.items()}, {})
                for record, each in zip(self._records, told, strict=True)
            ],
            slow=SLOW,
            release=self._dataset.version,
            python=find_call(filters),
            command=shlex.join(
                ["deepaccident", "explore", "DATAROOT", *where_words(filters), "--out", "DIR"]
            ),
        )

    def _write_scenario(self, place: int, told: Told) -> None:
        tokens = list(self._names)
        token = tokens[place]
        twin = twin_of(self._dataset, token)
        self._write_page(
            f"{self._names[token]}/{INDEX}",
            "written_scenario.html",
            "../../",
            token=token,
            before=tokens[place - 1] if place else None,
            after=tokens[place + 1] if place + 1 < len(tokens) else None,
            twin=twin["token"] if twin is not None and twin["token"] in self._names else None,
            facts=told.facts,
            parts=PARTS,
            told=told.parts,
            model=told.model,
            reason=told.reason,
            replay=_REPLAY_FILE,
        )

    def _write_page(self, name: str, template: str, root: str, **context: Any) -> None:
        """Write a page from a template; `root` is its way to the first one."""

        def own(token: str) -> str:
            return f"{root}{quote(self._names[token])}"

        text = rendered(
            template,
            root=root,
            models=(),
            static=True,
            policy=_POLICY,
            asset=lambda _, name: f"{root}{_STATIC}/{name}",
            scenario_at=lambda _, token: f"{own(token)}/{INDEX}",
            named=lambda token: scenario_words(self._dataset.scenario.get(token)),
            thumbnail_at=lambda _, token: f"{own(token)}/{THUMBNAIL}",
            **context,
        )
        write_bytes(self._folder / name, text.encode())
