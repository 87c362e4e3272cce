"""Pages of some scenarios as files, for a talk or a supplement.

They need neither a server nor a network.
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
from deepaccident_devkit.plugins.explore.choices import format_find_call, format_where_options
from deepaccident_devkit.plugins.explore.explorer import thumbnail
from deepaccident_devkit.plugins.explore.models import Model, open_models
from deepaccident_devkit.plugins.explore.pages.release import SLOW, make_entry, make_table_cell
from deepaccident_devkit.plugins.explore.pages.responses import assets
from deepaccident_devkit.plugins.explore.pages.scenario import PARTS, make_part_context
from deepaccident_devkit.plugins.explore.scenarios import read_accident_fields
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
from deepaccident_devkit.support.text import PathType, path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.tables.records import ScenarioRecord

# Name of the file that marks the folder of an export, and lists all files that were written.
MARK: Final = ".deepaccident_pages"
_HEAD = "DeepAccident pages"
_REPLAY_FILE = "replay.html"
THUMBNAIL: Final = "thumbnail.jpg"
# Largest number of scenarios in an export, since each replay takes some seconds and up to 15 MB.
MAX_SCENARIOS: Final = 50
INDEX: Final = "index.html"
_STATIC = "static"
_ASSETS = ("pages.css", "explore.css", "keys.js", "sorting.js")
# Only the files of the export are loaded, from a disk or from a server.
_CONTENT_POLICY = (
    "default-src 'none'; script-src 'self' file:; style-src 'self' file:; img-src 'self' file: "
    "data:; frame-src 'self' file:; base-uri 'none'; form-action 'none'"
)


def check_export_folder(folder: PathType) -> Path:
    """Return the real path of a folder for an export.

    Raises ConfigError if it cannot be written to or holds other files.
    """
    target = path_of(folder, "expected a folder to write to").resolve()
    writable_folder(target.parent)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target}: is a file; choose a folder that does not exist yet")
    foreign_files = sorted(set(_list_files(target)) - set(_read_exported_files(target)))
    if foreign_files:
        raise ConfigError(
            f"{target}: contains {foreign_files[0]}, which no export wrote; choose a folder that "
            "is empty or does not exist yet"
        )
    return target


@contextmanager
def replace_export(target: Path) -> Iterator[Path]:
    """Yield a new folder, which replaces the target if the block succeeds."""
    backup = temporary_path(target)
    try:
        with replacing_folder(target) as folder:
            yield folder
            lines = [_HEAD, *sorted(_list_files(folder))]
            write_bytes(folder / MARK, "".join(f"{line}\n" for line in lines).encode())
            if target.is_dir() and any(target.iterdir()):
                target.rename(backup)
    finally:
        shutil.rmtree(backup, ignore_errors=True)


def _list_files(folder: Path) -> Iterator[str]:
    """Yield the path of each file and link below a folder, relative to it."""
    for path, folders, files in os.walk(folder):
        links = [name for name in folders if Path(path, name).is_symlink()]
        for name in (*links, *files):
            yield Path(path, name).relative_to(folder).as_posix()


def _read_exported_files(folder: Path) -> list[str]:
    """Return the files that an earlier export wrote into a folder; none if there was no export."""
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
        predictions: Name, results and task of the models that have predictions for it.
    """

    token: str
    folder: str
    predictions: tuple[tuple[str, Results, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioContent:
    """The content of a scenario's page, except its thumbnail and replay, which are files.

    Attributes:
        facts: Names and values of the facts about the scenario.
        parts: HTML of each of the `PARTS`, by name.
        measures: Values of the columns in `SLOW`.
        model: Name of the model that made the replay's predictions; empty for none.
        reason: Why there is no replay; empty if there is one.
    """

    facts: Sequence[Sequence[str]]
    parts: Mapping[str, str]
    measures: Mapping[str, Any]
    model: str
    reason: str


def write_scenario_pages(
    dataset: Dataset, folder: Path, scenario: _ExportedScenario
) -> ScenarioContent:
    """Write the files of a scenario below an export's folder, and return its page's content."""
    token = scenario.token
    record = dataset.scenario.get(token)
    own_folder = folder / scenario.folder
    write_bytes(own_folder / THUMBNAIL, thumbnail(dataset, record))
    measures = read_accident_fields(dataset, record)
    measures |= measures_of_moving_pairs(interactions(dataset, record))
    model, reason = _make_replay(dataset, scenario, own_folder / _REPLAY_FILE)
    return ScenarioContent(
        facts=facts(recording_of(dataset, token, None)),
        parts={name: _render_part(dataset, token, name) for name in PARTS},
        measures={name: measures[name] for name in SLOW},
        model=model,
        reason=_hide_dataroot(dataset, reason),
    )


def _make_replay(dataset: Dataset, scenario: _ExportedScenario, path: Path) -> tuple[str, str]:
    """Write a replay with the first predictions that can be shown.

    If none can be shown, the replay has no predictions. Returns the name of the predictions' model
    (empty if there are none), and the reason if no replay could be written (otherwise empty).
    """
    for name, prediction, task in scenario.predictions:
        if tried_replay(dataset, scenario.token, path, prediction=prediction, task=task) is None:
            return name, ""
    return "", tried_replay(dataset, scenario.token, path) or ""


def _render_part(dataset: Dataset, token: str, name: str) -> str:
    context = make_part_context(dataset, token, name)
    if "findings" in context:
        findings = []
        for finding in context["findings"]:
            where = _hide_dataroot(dataset, finding.where)
            text = _hide_dataroot(dataset, finding.what)
            findings.append(replace(finding, where=where, what=text))
        context["findings"] = findings
    return rendered(f"parts/{name}.html", root="", static=True, frame_number=str, **context)


def _hide_dataroot(dataset: Dataset, text: str) -> str:
    """Make the paths in a text relative to the folder of the release.

    Pages for others should not reveal where the release is stored.
    """
    return text.replace(f"{dataset.dataroot}/", "")


def export_pages(
    dataset: Dataset,
    folder: PathType,
    *,
    where: Sequence[str] = (),
    bundles: Iterable[Path] = (),
    results: Iterable[Path] = (),
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> Path:
    """Write pages of some scenarios as files.

    The pages are a list of the scenarios and, for each scenario, a replay, its story, pairs, lead
    times and findings. They work from a disk without a server or network, and from any web server.
    Nothing in them reveals where the release is stored. The same call gives the same bytes.

    Args:
        dataset: The release.
        folder: Folder to write to, which is new, empty, or an earlier export, which is replaced.
        where: Filters as for `find`; a scenario must match all of them.
        bundles: Folders that `save_run` wrote with their results.
        results: Files or folders of results. A replay shows the first predictions that exist for
            its scenario; bundles come before other results.
        scenarios: Tokens or records of scenarios; those that match the filters are written, in this
            order. None for all.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Returns:
        The first page, `index.html`.

    Raises:
        ConfigError: If more than 50 scenarios match, or the folder cannot be written to or holds
            other files.
        NotAvailableError: If no scenario matches.
        FieldError, ChoiceError, TokenError: If there is no such filter or scenario.
        ResultsError: If bundles or results cannot be read.
        WorkerError: See `parallel.Engine`.

    Examples:
        >>> export_pages(
        ...     da, "night", where=["time_of_day=Night", "collision=true"]
        ... )  # doctest: +SKIP
    """
    tokens: list[str] | None = None
    if scenarios is not None:
        tokens = [dataset.get("scenario", scenario)["token"] for scenario in scenarios]
    records = _find_records(dataset, where, tokens)
    target = check_export_folder(folder)
    models = open_models(bundles, results, Jobs())
    filters = [*where]
    if tokens is not None:
        filters.append(f"token={','.join(tokens)}")
    with replace_export(target) as new_folder:
        _Pages(dataset, new_folder, records, models).write(filters, **engine)
    return target / INDEX


def _find_records(
    dataset: Dataset, where: Sequence[str], tokens: Sequence[str] | None
) -> list[ScenarioRecord]:
    """Return the scenarios to write; raise ConfigError if there are too many."""
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


def _name_folders(records: Sequence[ScenarioRecord]) -> dict[str, str]:
    """Name each scenario's folder `TYPE/NAME`, in letters that all file systems support."""
    names_by_type: dict[str, list[str]] = {}
    for record in records:
        names_by_type.setdefault(record["scenario_type"], []).append(record["name"])
    types = plain_names(names_by_type, reserved=(_STATIC, INDEX, MARK))
    plain_by_type = {kind: plain_names(names) for kind, names in names_by_type.items()}
    folders = {}
    for record in records:
        kind = record["scenario_type"]
        name = plain_by_type[kind][record["name"]]
        folders[record["token"]] = f"{types[kind]}/{name}"
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
        self._dataset = dataset
        self._folder = folder
        self._records = records
        self._models = models
        self._names = _name_folders(records)

    def write(self, filters: Sequence[str], **engine: Unpack[Engine]) -> None:
        """Write all pages of the scenarios that match filters; `engine` is as in `export_pages`."""
        items = [
            _ExportedScenario(token=token, folder=name, predictions=self._find_predictions(token))
            for token, name in self._names.items()
        ]
        places = Places(reads=self._dataset.places, writes=(self._folder,))
        work = partial(write_scenario_pages, self._dataset, self._folder)
        contents = run_batch(work, items, label="Writing pages", places=places, **engine)
        for name in _ASSETS:
            write_bytes(self._folder / _STATIC / name, assets()[name].encode())
        for index, content in enumerate(contents):
            self._write_scenario(index, content)
        self._write_index(filters, contents)

    def _find_predictions(self, token: str) -> tuple[tuple[str, Results, str], ...]:
        """Return the predictions that a replay of the scenario can show."""
        predictions = []
        for name, model in self._models.items():
            if model.results is not None and token in model.scenarios:
                predictions.append((name, model.results, model.setup.task))
        return tuple(predictions)

    def _write_index(self, filters: Sequence[str], contents: Sequence[ScenarioContent]) -> None:
        entries = []
        for record, content in zip(self._records, contents, strict=True):
            cells = {name: make_table_cell(value) for name, value in content.measures.items()}
            entries.append(make_entry(record, cells, {}))
        options = [*format_where_options(filters), "--out", "DIR"]
        self._write_page(
            INDEX,
            "written_list.html",
            "./",
            entries=entries,
            slow=SLOW,
            release=self._dataset.version,
            python=format_find_call(filters),
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
        """Write a page from a template; `root` is the relative address of the first page."""

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
