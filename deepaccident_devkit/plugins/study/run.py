"""`run_study`: makes a study cell by cell, from its recipe to its results."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.breakdowns import cluster_of, sample_attributes, tokens_by_value
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.plugins.study.cells import (
    Notes,
    RowEvaluation,
    StudyCell,
    Workspace,
    copy_weights,
    make_cell,
    train_weights,
)
from deepaccident_devkit.plugins.study.numbers import HIDDEN
from deepaccident_devkit.plugins.study.overlap import ReleaseScenarios, known_scenarios
from deepaccident_devkit.plugins.study.page import save_study
from deepaccident_devkit.plugins.study.recipe import (
    DEFAULT_HORIZON,
    NUSCENES,
    Recipe,
    Settings,
    TrainingPlan,
    recipe_place,
    synth_config_of,
)
from deepaccident_devkit.plugins.study.summary import (
    ALL,
    Counted,
    StudyReport,
    counted_of,
    summarised,
)
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.plugins.synth.generate import file_text
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.selection import find
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.reading import file_checksum
from deepaccident_devkit.support.text import PathType, choice, counted, natural_order
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.plugins.model import ModelChoice
    from deepaccident_devkit.support.parallel import Engine

# Release settings that the keys of earlier studies lack → the values in those studies.
_LATER_SETTINGS = {"rig": "released", "decimals": None}
# The model, and seed → cell of the weights; weights from a file have the seed "".
_Weights = tuple["ModelChoice", dict[str, StudyCell]]
# The cell of a release, and the opened release.
_Release = tuple[StudyCell, DeepAccident]


def run_study(
    recipe: Recipe, out: PathType, *, device: str = "auto", **engine: Unpack[Engine]
) -> StudyReport:
    """Make the missing cells of a study, and write its results into `out/NAME`.

    NAME is that of the recipe. After a kill, the same call resumes. Studies with the same `out`
    share releases, weights and rows.

    Args:
        recipe: A recipe returned by `read_recipe`.
        out: Folder for one or more studies.
        device: Device on which models run: `auto`, `cpu`, `cuda`, …
        **engine: `workers` (None for the number of cores, or one with a GPU), `executor` and
            `progress`; see `parallel.Engine`.

    Returns:
        The report. It is also written to the folder: `study.json`, `tables/*.csv`, `figures/*.png`,
        `index.html`, and the counts of all samples as `counts.json.gz` (`read_counts`).

    Raises:
        ConfigError: If the weights or samples of the recipe are impossible, or something cannot be
            written.
        SomeFailedError: If some cells failed; the others are finished.
        DeepAccidentError: For the reasons in `make_release`, `model.train` and `evaluate_results`.
    """
    if recipe.weights:
        need_plugin("model", "a study with weights")
        from deepaccident_devkit.plugins.model import checked_device

        device = checked_device(device)
    cell_device = device if recipe.weights else "cpu"
    workspace = Workspace(writable_folder(out).absolute(), cell_device)
    default_workers = 1 if device.startswith("cuda") else usable_cores()
    cell_engine: Any = {**engine, "workers": engine.get("workers") or default_workers}
    test = recipe.test
    with workspace.store.shared():
        releases = {}
        for name in recipe.releases:
            releases[name] = _make_release(workspace, name, recipe, **engine)
        _, dataset = releases[test.release]
        candidates = _scenarios_of_split(dataset, test.split)
        tested = _find_matching_scenarios(dataset, test.where, candidates, recipe, "test.where")
        if not test.includes_training:
            _refuse_known_scenarios(recipe, releases, (dataset, tested))
        weights = _make_weights(recipe, workspace, releases, **cell_engine)
        rows = _row_cells(recipe, workspace, releases[test.release], weights, tested)
        cells_of_rows = list(chain.from_iterable(seeds.values() for seeds in rows.values()))
        workspace.make_cells(
            cells_of_rows, "Predicting and evaluating rows", dataset.places, **cell_engine
        )
        row_counts = _collect_counts(recipe, dataset, rows)
        cells = [cell for cell, _ in releases.values()]
        for _, weight_cells in weights.values():
            cells += weight_cells.values()
        cells += cells_of_rows
        cell_notes = [_notes_without_counts(cell) for cell in cells]
    summary = {
        **summarised(row_counts),
        "recipe": msgspec.to_builtins(recipe),
        "devkit": __version__,
        "cells": cell_notes,
    }
    report = StudyReport(summary=json.loads(json.dumps(summary)))
    save_study(report, row_counts, workspace.out / recipe.name)
    return report


def _notes_without_counts(cell: StudyCell) -> Notes:
    """Return what the report contains about a cell: its notes without the counts."""
    notes = {"kind": cell.kind, "name": cell.name, "key": cell.key, **(cell.notes or {})}
    notes.pop("counts", None)
    return notes


def _make_release(
    workspace: Workspace, name: str, recipe: Recipe, **engine: Unpack[Engine]
) -> _Release:
    """Return the cell of a release, and open it; if missing, all workers make it together."""
    source = recipe.releases[name]
    config = synth_config_of(source)
    decides: Notes = {}
    if config is None:
        dataset = _open_release(source)
        decides = {**source, "release": release_note(dataset, _scenarios_of_split(dataset))}
    else:
        for setting, value in asdict(config).items():
            if _LATER_SETTINGS.get(setting, ...) != value:
                decides[setting] = value
        decides["spec"] = config.spec and file_text(config.spec)
        if source.get(NUSCENES):
            decides[NUSCENES] = True
    work = partial(_write_release, source, engine)
    cell = workspace.cell("release", name, work, **decides)
    make_cell(cell)
    return cell, _open_release(source, cell.folder)


def _open_release(source: Settings, folder: Path | None = None) -> DeepAccident:
    """Open a release; convert it to nuScenes' format if the recipe asks for it."""
    if folder is not None and source.get(NUSCENES):
        need_plugin("nuscenes", "a study on nuScenes")
        from deepaccident_devkit.plugins.nuscenes.check import check_source
        from deepaccident_devkit.plugins.nuscenes.source import open_nuscenes

        nuscenes = open_nuscenes(folder / NUSCENES)
        check_source(nuscenes)
        return nuscenes
    version = source.get("version", "v1")
    return DeepAccident(version, source.get("dataroot", folder), verbose=False)


def _write_release(source: Settings, engine: Any, folder: Path) -> Notes:
    """Write a release if it is missing; return its number of scenarios, and its fingerprint."""
    config = synth_config_of(source)
    release = folder
    if source.get(NUSCENES):
        release = folder.with_name(f"{folder.name}-release")
    if config is not None and not release.is_dir():
        make_release(release, config, **engine)
    if release != folder and not (folder / NUSCENES).is_dir():
        form = NuScenes(agents=AGENTS[:1], lidar_axes="nuscenes", sweeps=False)
        dataset = DeepAccident("v1", release, verbose=False)
        export_release(dataset, folder / NUSCENES, form, **engine)
    folder.mkdir(parents=True, exist_ok=True)  # for existing releases, it stays empty
    dataset = _open_release(source, folder)
    quiet_engine = {name: value for name, value in engine.items() if name != "progress"}
    hashes = scenario_hashes(dataset, _scenarios_of_split(dataset), **quiet_engine)
    return {"scenarios": len(hashes), "fingerprint": fingerprint(hashes)}


def _scenarios_of_split(dataset: DeepAccident, split: str = "all") -> list[str]:
    """Return the tokens of the scenarios in a split, in the order of the release."""
    split_tokens = dataset.split_scenarios(split)
    tokens = [record["token"] for record in dataset.scenario]
    return [token for token in tokens if token in split_tokens]


def _refuse_known_scenarios(
    recipe: Recipe, releases: Mapping[str, _Release], tested: ReleaseScenarios
) -> None:
    """Raise a ConfigError if a training contains test scenarios, or their twins."""
    for name in recipe.weights:
        plan = recipe.plan(name)
        splits = (
            (plan.release, plan.split),
            (plan.release, plan.validation),
            (plan.also, plan.also_split),
        )
        for release, split in splits:
            if not release or not split:
                continue
            with recipe_place(recipe.name, f"weights.{name}"):
                _, dataset = releases[release]
                learned = _scenarios_of_split(dataset, split)
                known_tokens = known_scenarios((dataset, learned), tested)
                if known_tokens:
                    raise ConfigError(
                        f"{release}, {split}: contains {counted(len(known_tokens), 'scenario')} of "
                        f"the test, or their twins, such as {known_tokens[0]}; change split, "
                        "also_split or validation here, or the split of the test, or set "
                        "includes_training: true in test"
                    )


def _make_weights(
    recipe: Recipe,
    workspace: Workspace,
    releases: Mapping[str, _Release],
    **engine: Unpack[Engine],
) -> dict[str, _Weights]:
    """Make all missing weights; return the weights by name.

    Weights that start from random ones are made together. Weights that start from these follow, and
    so on.
    """
    weights: dict[str, _Weights] = {}
    depths: dict[str | None, int] = {None: -1}
    for name, plan in recipe.weights.items():
        depths[name] = depths[plan.get("from")] + 1
        with recipe_place(recipe.name, f"weights.{name}"):
            weights[name] = _weight_cells(name, recipe, workspace, releases, weights)
    reads: list[Path] = []
    for _, dataset in releases.values():
        reads += dataset.places
    for depth in range(max(depths.values()) + 1):
        cells: list[StudyCell] = []
        for name, (_, cells_by_seed) in weights.items():
            if depths[name] == depth:
                cells += cells_by_seed.values()
        workspace.make_cells(cells, "Training weights", tuple(reads), **engine)
    return weights


def _weight_cells(
    name: str,
    recipe: Recipe,
    workspace: Workspace,
    releases: Mapping[str, _Release],
    earlier_weights: Mapping[str, _Weights],
) -> _Weights:
    """Return the model of some weights, and the cell of each seed.

    Raise ConfigError, ChoiceError or ValueError if the recipe's settings for it are wrong.
    """
    from deepaccident_devkit.plugins.model import (
        ModelChoice,
        SecondSource,
        TrainConfig,
        read_weights,
    )

    plan = recipe.plan(name)
    settings = recipe.weights[name]
    if plan.file is not None:
        file = read_weights(plan.file)
        work = partial(copy_weights, file.path)
        cell = workspace.cell("weights", name, work, file=file_checksum(file.path))
        return ModelChoice.from_dict(file.meta, file.path), {"": cell}
    release_cell, dataset = releases[plan.release]
    model_keys = [field.name for field in fields(ModelChoice)]
    training_keys = [field.name for field in fields(TrainConfig)]
    decides: NamedValues = {}
    second_source = None
    if plan.also is not None:
        other_cell, other_dataset = releases[plan.also]
        other_split = workspace.split(_scenarios_of_split(other_dataset, plan.also_split))
        second_source = SecondSource(dataset=other_dataset, split=str(other_split), mix=plan.mix)
        decides["also"] = {"release": other_cell.key, "mix": plan.mix}
        if plan.also_split != "all":  # earlier studies always used "all", and their keys lack it
            decides["also"]["split"] = other_split.name
    plan_keys = TrainingPlan.__struct_encode_fields__
    valid_keys = [key for key in (*plan_keys, *model_keys, *training_keys) if key != "seed"]
    for key in settings:
        choice("key", key, valid_keys)
    start_model = ModelChoice()
    start_cells: dict[str, StudyCell] = {}
    if plan.start:
        start_model, start_cells = earlier_weights[plan.start]
    model_settings = {key: settings[key] for key in model_keys if key in settings}
    model = as_record({**start_model.as_dict(), **model_settings}, ModelChoice)
    training_settings = {key: settings[key] for key in training_keys if key in settings}
    split = workspace.split(_scenarios_of_split(dataset, plan.split))
    cells = {}
    for seed in recipe.seeds:
        seed_settings = {**training_settings, "split": str(split), "seed": seed}
        config = as_record({"validation": None, **seed_settings}, TrainConfig)
        start_cell = start_cells.get(str(seed), start_cells.get(""))
        start_folder = None
        start_key = None
        if start_cell is not None:
            start_folder = start_cell.folder
            start_key = start_cell.key
        work = partial(
            train_weights, dataset, model, config, start_folder, second_source, workspace.device
        )
        cells[str(seed)] = workspace.cell(
            "weights",
            f"{name}, seed {seed}",
            work,
            release=release_cell.key,
            model=model.as_dict(),
            training={**config.as_dict(), "split": split.name},
            start=start_key,
            **decides,
        )
    return model, cells


def _row_cells(
    recipe: Recipe,
    workspace: Workspace,
    release: _Release,
    weights: Mapping[str, _Weights],
    scenarios: Sequence[str],
) -> dict[str, dict[str, StudyCell]]:
    """Return row → seed → cell; all cells have the same samples."""
    release_cell, dataset = release
    test = recipe.test
    horizons = {}
    for row in recipe.rows:
        owner = weights[row.weights][0] if row.weights else row
        horizons[row.name] = owner.horizon or DEFAULT_HORIZON
    selection = SampleSelection(
        split=str(workspace.split(scenarios)),
        samples=test.samples,
        scope=test.scope,
        agents=test.agents,
        horizon=test.horizon or max(horizons.values()),
    )
    with recipe_place(recipe.name, "test"):
        if not scenarios:
            raise ConfigError("where: no scenario pair matches; change the filters")
        selection.tokens(dataset)
    samples = {**selection.as_dict(), "split": Path(selection.split).name}
    cells: dict[str, dict[str, StudyCell]] = {}
    for row in recipe.rows:
        cells_of_weights: Mapping[str, StudyCell | None] = {"": None}
        if row.weights:
            cells_of_weights = weights[row.weights][1]
        decides = msgspec.to_builtins(row)
        for key in ("name", "weights", "over", "horizon"):
            decides.pop(key, None)
        labels = test.label_config(horizons[row.name])
        cells[row.name] = {}
        for seed, weights_cell in cells_of_weights.items():
            name = f"{row.name}, seed {seed}" if seed else row.name
            weights_folder = None
            weights_key = None
            if weights_cell is not None:
                weights_folder = weights_cell.folder
                weights_key = weights_cell.key
            evaluation = RowEvaluation(
                dataset=dataset,
                row=row,
                selection=selection,
                labels=labels,
                weights=weights_folder,
                device=workspace.device,
            )
            cells[row.name][seed] = workspace.cell(
                "row",
                name,
                evaluation,
                **decides,
                labels=[test.labels, horizons[row.name]],
                samples=samples,
                release=release_cell.key,
                trained=weights_key,
            )
    return cells


def _find_matching_scenarios(
    dataset: DeepAccident,
    where: Sequence[str],
    scenarios: Iterable[str],
    recipe: Recipe,
    place: str,
) -> list[str]:
    """Return the scenarios of all pairs in which either scenario satisfies every filter.

    Args:
        dataset: The release.
        where: Filters, in the syntax of `--where`.
        scenarios: Tokens of the candidates.
        recipe: The recipe.
        place: Where the recipe contains the filters, for error messages.

    Raises:
        ConfigError: If a filter is wrong.
    """
    with recipe_place(recipe.name, place):
        pairs = {cluster_of(record["token"]) for record in find(dataset, *where)}
    return [token for token in scenarios if cluster_of(token) in pairs]


def _collect_counts(
    recipe: Recipe, dataset: DeepAccident, rows: Mapping[str, Mapping[str, StudyCell]]
) -> Counted:
    """Collect the counts of all rows, and the groups of samples."""
    description = {
        "title": recipe.title,
        "question": recipe.question,
        "labels": recipe.test.labels,
        "headline": msgspec.to_builtins(recipe.headline),
        "compare": [list(pair) for pair in recipe.pairs],
        "over": {row.name: row.over and list(row.over) for row in recipe.rows},
    }
    counts: dict[str, NamedValues] = {}
    for name, cells in rows.items():
        counts[name] = {seed: (cell.notes or {})["counts"] for seed, cell in cells.items()}
    counts_of_a_row = next(iter(counts.values()))
    counts_of_a_seed = next(iter(counts_of_a_row.values()))
    tokens = sorted(counts_of_a_seed[HIDDEN])
    groups = {ALL: tokens}
    scenarios = [scenario_of(token) for token in tokens]
    for name, where in recipe.groups.items():
        matches = set(_find_matching_scenarios(dataset, where, scenarios, recipe, f"groups.{name}"))
        groups[name] = [token for token in tokens if scenario_of(token) in matches]
    attributes = sample_attributes(dataset, tokens) if recipe.by else {}
    for attribute in recipe.by:
        values = tokens_by_value(attributes, attribute)
        for value in sorted(values, key=natural_order):
            groups[f"{attribute}={value or 'unknown'}"] = values[value]
    return counted_of(counts, groups, description)
