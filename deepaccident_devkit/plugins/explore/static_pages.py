"""`export_pages`: pages of some scenarios as files, for a talk or a supplement.

They need no server and no network.
"""

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

# Name of the file that marks the folder of an export; it lists all files that were written.
MARK: Final = ".deepaccident_pages"
_HEAD: Final = "DeepAccident pages"
_REPLAY_FILE: Final = "replay.html"
THUMBNAIL: Final = "thumbnail.jpg"
# Largest number of scenarios of an export: a replay takes some seconds and up to 15 MB.
MAX_SCENARIOS: Final = 50
INDEX: Final = "index.html"
_STATIC: Final = "static"
_ASSETS: Final = ("pages.css", "explore.css", "keys.js", "sorting.js")
# Only the files of the export are loaded, from a disk or from a server.
_CONTENT_POLICY: Final = (
    "default-src 'none'; script-src 'self' file:; style-src 'self' file:; img-src 'self' file: "
    "data:; frame-src 'self' file:; base-uri 'none'; form-action 'none'"
)


def target_folder(folder: str | os.PathLike[str]) -> Path:
    """Return the real path of a folder for an export.

    Raises ConfigError if it cannot be written to, or holds other files.
    """
    target = path_of(folder, "expected a folder to write to").resolve()
    writable_folder(target.parent)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target}: is a file; name a folder that does not exist yet")
    foreign_files = sorted(set(_files(target)) - set(_exported_files(target)))
    if foreign_files:
        raise ConfigError(
            f"{target}: holds {foreign_files[0]}, which no export wrote; name a folder that is "
            "empty, or does not exist yet"
        )
    return target


@contextmanager
def exported(target: Path) -> Iterator[Path]:
    """Yield a new folder; if the block succeeds, it replaces the target and an earlier export."""
    backup = temporary_path(target)
    try:
        with replacing_folder(target) as folder:
            yield folder
            lines = [_HEAD, *sorted(_files(folder))]
            write_bytes(folder / MARK, "".join(f"{line}\n" for line in lines).encode())
            if target.is_dir() and any(target.iterdir()):
                target.rename(backup)
    finally:
        shutil.rmtree(backup, ignore_errors=True)


def _files(folder: Path) -> Iterator[str]:
    """Yield all files and links below a folder, relative to it."""
    for path, folders, files in os.walk(folder):
        links = [name for name in folders if Path(path, name).is_symlink()]
        for name in (*links, *files):
            yield Path(path, name).relative_to(folder).as_posix()


def _exported_files(folder: Path) -> list[str]:
    """Return the files that an earlier export wrote into a folder; none without an export."""
    mark = folder / MARK
    if not mark.is_file() or mark.is_symlink():
        return []
    head, *names = read_bytes(mark, "index").decode(errors="replace").splitlines()
    if head == _HEAD:
        return [*names, MARK]
    return []


@dataclass(frozen=True, slots=True, kw_only=True)
class _ExportedScenario:
    """A scenario of an export.

    Attributes:
        token: Token of the scenario.
        folder: Folder of the scenario, relative to the folder of the export.
        predictions: Names and results of the models with predictions for it.
    """

    token: str
    folder: str
    predictions: tuple[tuple[str, Results], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioContent:
    """The content of a scenario's page; its thumbnail and replay are files.

    Attributes:
        facts: Names and values.
        parts: The `PARTS` as HTML.
        measures: Values of the columns `SLOW`.
        model: Name of the model with the predictions of the replay; empty for none.
        reason: Reason why there is no replay; empty if there is one.
    """

    facts: Sequence[Sequence[str]]
    parts: Mapping[str, str]
    measures: Mapping[str, Any]
    model: str
    reason: str


def write_scenario(dataset: Dataset, folder: Path, scenario: _ExportedScenario) -> ScenarioContent:
    """Write a scenario's files below the folder of the export; return the content of its page."""
    token = scenario.token
    record = dataset.scenario.get(token)
    own_folder = folder / scenario.folder
    write_bytes(own_folder / THUMBNAIL, thumbnail(dataset, record))
    measures = accident_fields(dataset, record)
    measures |= measures_of_moving_pairs(interactions(dataset, record))
    model, reason = _make_replay(dataset, scenario, own_folder / _REPLAY_FILE)
    return ScenarioContent(
        facts=facts(recording_of(dataset, token, None)),
        parts={name: _part(dataset, token, name) for name in PARTS},
        measures={name: measures[name] for name in SLOW},
        model=model,
        reason=_without_dataroot(dataset, reason),
    )


def _make_replay(dataset: Dataset, scenario: _ExportedScenario, path: Path) -> tuple[str, str]:
    """Write a replay with the first predictions that can be shown.

    Return the name of their model, and the reason if there is no replay.
    """
    for name, prediction in scenario.predictions:
        if tried_replay(dataset, scenario.token, path, prediction=prediction) is None:
            return name, ""
    return "", tried_replay(dataset, scenario.token, path) or ""


def _part(dataset: Dataset, token: str, name: str) -> str:
    context = part_context(dataset, token, name)
    if "findings" in context:
        findings = []
        for finding in context["findings"]:
            where = _without_dataroot(dataset, finding.where)
            text = _without_dataroot(dataset, finding.what)
            findings.append(replace(finding, where=where, what=text))
        context["findings"] = findings
    return rendered(f"parts/{name}.html", root="", static=True, frame_number=str, **context)


def _without_dataroot(dataset: Dataset, text: str) -> str:
    """Return a text with paths relative to the release's folder.

    Pages for others should not reveal where the release lies.
    """
    return text.replace(f"{dataset.dataroot}/", "")


def export_pages(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    *,
    where: Sequence[str] = (),
    bundles: Iterable[Path] = (),
    results: Iterable[Path] = (),
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> Path:
    """Write pages of some scenarios as files.

    There is a list, and for each scenario a replay, its story, pairs, lead times and findings. They
    work from a disk, without a server and a network, and from any web server. Nothing in them
    reveals where the release lies. The same call gives the same bytes.

    Args:
        dataset: The release.
        folder: Output folder; new, empty, or an earlier export, which is replaced.
        where: Filters as for `find`; a scenario must match all.
        bundles: Folders that `save_run` wrote with their results.
        results: Files or folders of results. A replay shows the first predictions for its scenario,
            from bundles before others.
        scenarios: Tokens or records; the ones that match are written, in this order. None for all.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Returns:
        The first page, `index.html`.

    Raises:
        ConfigError: More than 50 scenarios match; or the folder cannot be written to, or holds
            other files.
        NotAvailableError: No scenario matches.
        FieldError, ChoiceError, TokenError: There is no such filter or scenario.
        ResultsError: Bundles or results cannot be read.
        WorkerError: See `parallel.Engine`.

    Examples:
        >>> export_pages(
        ...     da, "night", where=["time_of_day=Night", "collision=true"]
        ... )  # doctest: +SKIP
    """
    tokens: list[str] | None = None
    if scenarios is not None:
        tokens = [dataset.get("scenario", scenario)["token"] for scenario in scenarios]
    records = _matching_records(dataset, where, tokens)
    target = target_folder(folder)
    models = open_models(bundles, results, Jobs())
    filters = [*where]
    if tokens is not None:
        filters.append(f"token={','.join(tokens)}")
    with exported(target) as new_folder:
        _Pages(dataset, new_folder, records, models).write(filters, **engine)
    return target / INDEX


def _matching_records(
    dataset: Dataset, where: Sequence[str], tokens: Sequence[str] | None
) -> list[ScenarioRecord]:
    """Return the scenarios to write; raise ConfigError if they are too many."""
    records = find(dataset, *where)
    if tokens is not None:
        by_token = {record["token"]: record for record in records}
        records = [by_token[token] for token in dict.fromkeys(tokens) if token in by_token]
    if not records:
        raise NotAvailableError(
            "no scenario matches, so there is nothing to export; change --where"
        )
    if len(records) > MAX_SCENARIOS:
        raise ConfigError(
            f"{len(records)} scenarios match, and at most {MAX_SCENARIOS} are exported; narrow "
            "--where"
        )
    return records


def _folders(records: Sequence[ScenarioRecord]) -> dict[str, str]:
    """Return scenario → its folder, `TYPE/NAME` in letters that all file systems support."""
    names_by_type: dict[str, list[str]] = {}
    for record in records:
        names_by_type.setdefault(record["scenario_type"], []).append(record["name"])
    types = plain_names(names_by_type, reserved=(_STATIC, INDEX, MARK))
    plain_by_type = {kind: plain_names(names) for kind, names in names_by_type.items()}
    folders = {}
    for record in records:
        kind = record["scenario_type"]
        folders[record["token"]] = f"{types[kind]}/{plain_by_type[kind][record['name']]}"
    return folders


class _Pages:
    """The pages of an export, written into a folder."""

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        records: Sequence[ScenarioRecord],
        models: Mapping[str, Model],
    ) -> None:
        self._dataset, self._folder, self._records, self._models = dataset, folder, records, models
        self._names = _folders(records)

    def write(self, filters: Sequence[str], **engine: Unpack[Engine]) -> None:
        """Write all pages of the scenarios that match filters; see `export_pages` for `engine`."""
        items = [
            _ExportedScenario(token=token, folder=name, predictions=self._predictions(token))
            for token, name in self._names.items()
        ]
        places = Places(reads=self._dataset.places, writes=(self._folder,))
        work = partial(write_scenario, self._dataset, self._folder)
        contents = run_batch(work, items, label="pages of scenarios", places=places, **engine)
        for name in _ASSETS:
            write_bytes(self._folder / _STATIC / name, assets()[name].encode())
        for index, content in enumerate(contents):
            self._write_scenario(index, content)
        self._write_index(filters, contents)

    def _predictions(self, token: str) -> tuple[tuple[str, Results], ...]:
        """Return the predictions that a replay of the scenario can show."""
        return tuple(
            (name, model.results)
            for name, model in self._models.items()
            if model.results is not None
            and model.results.task in FORESEEN
            and token in model.scenarios
        )

    def _write_index(self, filters: Sequence[str], contents: Sequence[ScenarioContent]) -> None:
        entries = []
        for record, content in zip(self._records, contents, strict=True):
            cells = {name: cell(value) for name, value in content.measures.items()}
            entries.append(entry(record, cells, {}))
        options = [*where_words(filters), "--out", "DIR"]
        self._write_page(
            INDEX,
            "written_list.html",
            "./",
            entries=entries,
            slow=SLOW,
            release=self._dataset.version,
            python=find_call(filters),
            command=shlex.join(["deepaccident", "explore", "DATAROOT", *options]),
        )

    def _write_scenario(self, index: int, content: ScenarioContent) -> None:
        tokens = list(self._names)
        token = tokens[index]
        twin = twin_of(self._dataset, token)
        self._write_page(
            f"{self._names[token]}/{INDEX}",
            "written_scenario.html",
            "../../",
            token=token,
            before=tokens[index - 1] if index else None,
            after=tokens[index + 1] if index + 1 < len(tokens) else None,
            twin=twin["token"] if twin is not None and twin["token"] in self._names else None,
            facts=content.facts,
            parts=PARTS,
            told=content.parts,
            model=content.model,
            reason=content.reason,
            replay=_REPLAY_FILE,
        )

    def _write_page(self, name: str, template: str, root: str, **context: Any) -> None:
        """Write a page from a template; `root` is its relative address of the first page."""

        def scenario_path(token: str) -> str:
            return f"{root}{quote(self._names[token])}"

        text = rendered(
            template,
            root=root,
            models=(),
            static=True,
            policy=_CONTENT_POLICY,
            asset=lambda _, name: f"{root}{_STATIC}/{name}",
            scenario_at=lambda _, token: f"{scenario_path(token)}/{INDEX}",
            named=lambda token: scenario_words(self._dataset.scenario.get(token)),
            thumbnail_at=lambda _, token: f"{scenario_path(token)}/{THUMBNAIL}",
            **context,
        )
        write_bytes(self._folder / name, text.encode())
