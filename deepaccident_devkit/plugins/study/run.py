"""`run_study`: from a recipe to its results, cell by cell."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.breakdowns import cluster_of, sample_attributes, tokens_by_value
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.plugins.study.cells import (
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
from deepaccident_devkit.support.text import choice, natural_order
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.plugins.model import ModelChoice
    from deepaccident_devkit.support.parallel import Engine

# Settings of releases that keys of earlier studies lack, with the values that these studies had.
_LATER_SETTINGS: Final = {"rig": "released", "decimals": None}
# The model, and the weights of each seed; weights from a file have an empty text as their seed.
_Weights = tuple["ModelChoice", dict[str, StudyCell]]
_Release = tuple[StudyCell, DeepAccident]


def run_study(
    recipe: Recipe, out: str | os.PathLike[str], *, device: str = "auto", **engine: Unpack[Engine]
) -> StudyReport:
    """Make the missing cells of a study, and write its results into `out/NAME`.

    NAME is the recipe's. After a kill the same call resumes. Studies with the same `out` share
    releases, weights and rows.

    Args:
        recipe: A recipe from `read_recipe`.
        out: Folder of one or several studies.
        device: Device of models: `auto`, `cpu`, `cuda`, …
        **engine: `workers` (None for the number of cores, or one with a GPU), `executor` and
            `progress`, as in `parallel.Engine`.

    Returns:
        The report. The folder has it as `study.json`, `tables/*.csv`, `figures/*.png`,
        `index.html`, and the counts of all samples as `counts.json.gz` (`read_counts`).

    Raises:
        ConfigError: The recipe asks for impossible weights or samples, or something cannot be
            written.
        SomeFailedError: Some cells failed; the others are done.
        DeepAccidentError: As in `make_release`, `model.train` and `evaluate_results`.
    """
    if recipe.weights:
        need_plugin("model", "a study with weights")
        from deepaccident_devkit.plugins.model import checked_device

        device = checked_device(device)
    workspace = Workspace(writable_folder(out).absolute(), device if recipe.weights else "cpu")
    default_workers = 1 if device.startswith("cuda") else usable_cores()
    cell_engine: Any = {**engine, "workers": engine.get("workers") or default_workers}
    test = recipe.test
    with workspace.store.shared():
        releases = {}
        for name in recipe.releases:
            releases[name] = _make_release(workspace, name, recipe, **engine)
        dataset = releases[test.release][1]
        candidates = _scenarios(dataset, test.split)
        tested = _matching_scenarios(dataset, test.where, candidates, recipe, "test.where")
        if not test.includes_training:
            _refuse_known_tests(recipe, releases, (dataset, tested))
        weights = _make_weights(recipe, workspace, releases, **cell_engine)
        rows = _row_cells(recipe, workspace, releases[test.release], weights, tested)
        cells_of_rows = [cell for seeds in rows.values() for cell in seeds.values()]
        workspace.make_cells(cells_of_rows, "rows", dataset.places, **cell_engine)
        counted = _counted(recipe, dataset, rows)
        cells = [cell for cell, _ in releases.values()]
        for _, weight_cells in weights.values():
            cells += weight_cells.values()
        cells += cells_of_rows
        cell_notes = [_notes_without_counts(cell) for cell in cells]
    summary = {
        **summarised(counted),
        "recipe": msgspec.to_builtins(recipe),
        "devkit": __version__,
        "cells": cell_notes,
    }
    report = StudyReport(summary=json.loads(json.dumps(summary)))
    save_study(report, counted, workspace.out / recipe.name)
    return report


def _notes_without_counts(cell: StudyCell) -> dict[str, Any]:
    """Return the report's entry of a cell."""
    notes = {"kind": cell.kind, "name": cell.name, "key": cell.key, **(cell.notes or {})}
    notes.pop("counts", None)
    return notes


def _make_release(
    workspace: Workspace, name: str, recipe: Recipe, **engine: Unpack[Engine]
) -> _Release:
    """Return a release, which all workers make if it is missing."""
    source = recipe.releases[name]
    config = synth_config_of(source)
    decides: dict[str, Any]
    if config is None:
        dataset = _open_release(source)
        decides = {**source, "release": release_note(dataset, _scenarios(dataset))}
    else:
        decides = {}
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


def _open_release(source: Mapping[str, Any], folder: Path | None = None) -> DeepAccident:
    """Open a release, in nuScenes' format if the recipe asks for it."""
    if folder is not None and source.get(NUSCENES):
        need_plugin("nuscenes", "a study on nuScenes")
        from deepaccident_devkit.plugins.nuscenes.check import check_source
        from deepaccident_devkit.plugins.nuscenes.source import open_nuscenes

        nuscenes = open_nuscenes(folder / NUSCENES)
        check_source(nuscenes)
        return nuscenes
    return DeepAccident(source.get("version", "v1"), source.get("dataroot", folder), verbose=False)


def _write_release(source: Mapping[str, Any], engine: Any, folder: Path) -> dict[str, Any]:
    """Write a release if it is missing; return its number of scenarios and fingerprint."""
    config = synth_config_of(source)
    release = folder.with_name(f"{folder.name}-release") if source.get(NUSCENES) else folder
    if config is not None and not release.is_dir():
        make_release(release, config, **engine)
    if release != folder and not (folder / NUSCENES).is_dir():
        form = NuScenes(agents=AGENTS[:1], lidar_axes="nuscenes", sweeps=False)
        dataset = DeepAccident("v1", release, verbose=False)
        export_release(dataset, folder / NUSCENES, form, **engine)
    folder.mkdir(parents=True, exist_ok=True)  # the folder of an existing release stays empty
    dataset = _open_release(source, folder)
    quiet_engine = {name: value for name, value in engine.items() if name != "progress"}
    hashes = scenario_hashes(dataset, _scenarios(dataset), **quiet_engine)
    return {"scenarios": len(hashes), "fingerprint": fingerprint(hashes)}


def _scenarios(dataset: DeepAccident, split: str = "all") -> list[str]:
    """Return the tokens of a split's scenarios, in the order of the release."""
    split_tokens = dataset.split_scenarios(split)
    return [record["token"] for record in dataset.scenario if record["token"] in split_tokens]


def _refuse_known_tests(
    recipe: Recipe, releases: Mapping[str, _Release], tested: ReleaseScenarios
) -> None:
    """Raise ConfigError if a training shows scenarios of the test, or their twins."""
    for name in recipe.weights:
        plan = recipe.plan(name)
        splits = (
            (plan.release, plan.split),
            (plan.release, plan.validation),
            (plan.also, plan.also_split),
        )
        for release, split in splits:
            if release and split:
                with recipe_place(recipe.name, f"weights.{name}"):
                    dataset = releases[release][1]
                    known = known_scenarios((dataset, _scenarios(dataset, split)), tested)
                    if known:
                        raise ConfigError(
                            f"{release}, {split}: shows {len(known)} scenarios of the test, or "
                            f"their twins, such as {known[0]}; change split, also_split or "
                            "validation here, or the test's split, or say includes_training: true "
                            "in test"
                        )


def _make_weights(
    recipe: Recipe,
    workspace: Workspace,
    releases: Mapping[str, _Release],
    **engine: Unpack[Engine],
) -> dict[str, _Weights]:
    """Return all weights, which are made if they are missing.

    Weights that begin from random ones are made together, then the weights that begin from these,
    and so on.
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
        workspace.make_cells(cells, "weights", tuple(reads), **engine)
    return weights


def _weight_cells(
    name: str,
    recipe: Recipe,
    workspace: Workspace,
    releases: Mapping[str, _Release],
    earlier_weights: Mapping[str, _Weights],
) -> _Weights:
    """Return the model of some weights and the cell of each seed.

    Raises ConfigError, ChoiceError or ValueError.
    """
    from deepaccident_devkit.plugins.model import (
        ModelChoice,
        SecondSource,
        TrainConfig,
        read_weights,
    )

    plan, settings = recipe.plan(name), recipe.weights[name]
    if plan.file is not None:
        file = read_weights(plan.file)
        work = partial(copy_weights, file.path)
        cell = workspace.cell("weights", name, work, file=file_checksum(file.path))
        return ModelChoice.from_dict(file.meta, file.path), {"": cell}
    release_cell, dataset = releases[plan.release]
    model_keys = [field.name for field in fields(ModelChoice)]
    training_keys = [field.name for field in fields(TrainConfig)]
    decides: dict[str, Any] = {}
    second_source = None
    if plan.also is not None:
        other_cell, other_dataset = releases[plan.also]
        other_split = workspace.split(_scenarios(other_dataset, plan.also_split))
        second_source = SecondSource(dataset=other_dataset, split=str(other_split), mix=plan.mix)
        decides["also"] = {"release": other_cell.key, "mix": plan.mix}
        if plan.also_split != "all":  # keys of earlier studies, which all had "all", lack it
            decides["also"]["split"] = other_split.name
    valid_keys = [*TrainingPlan.__struct_encode_fields__, *model_keys, *training_keys]
    valid_keys = [key for key in valid_keys if key != "seed"]
    for key in settings:
        choice("key", key, valid_keys)
    start_model, start_cells = earlier_weights[plan.start] if plan.start else (ModelChoice(), {})
    model_settings = {key: settings[key] for key in model_keys if key in settings}
    model = as_record({**start_model.as_dict(), **model_settings}, ModelChoice)
    training_settings = {key: settings[key] for key in training_keys if key in settings}
    split = workspace.split(_scenarios(dataset, plan.split))
    cells = {}
    for seed in recipe.seeds:
        config = as_record(
            {"validation": None, **training_settings, "split": str(split), "seed": seed},
            TrainConfig,
        )
        start_cell = start_cells.get(str(seed), start_cells.get(""))
        start_folder = None if start_cell is None else start_cell.folder
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
            start=None if start_cell is None else start_cell.key,
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
    """Return the cell of each seed of each row, all at the same samples of some scenarios."""
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
            raise ConfigError("where: no pair of scenarios matches; change the filters")
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
            evaluation = RowEvaluation(
                dataset=dataset,
                row=row,
                selection=selection,
                labels=labels,
                weights=None if weights_cell is None else weights_cell.folder,
                device=workspace.device,
            )
            cells[row.name][seed] = workspace.cell(
                "row",
                f"{row.name}, seed {seed}" if seed else row.name,
                evaluation,
                **decides,
                labels=[test.labels, horizons[row.name]],
                samples=samples,
                release=release_cell.key,
                trained=None if weights_cell is None else weights_cell.key,
            )
    return cells


def _matching_scenarios(
    dataset: DeepAccident,
    where: Sequence[str],
    scenarios: Iterable[str],
    recipe: Recipe,
    place: str,
) -> list[str]:
    """Return the scenarios of all pairs in which one matches all filters; raises ConfigError."""
    with recipe_place(recipe.name, place):
        pairs = {cluster_of(record["token"]) for record in find(dataset, *where)}
    return [token for token in scenarios if cluster_of(token) in pairs]


def _counted(
    recipe: Recipe, dataset: DeepAccident, rows: Mapping[str, Mapping[str, StudyCell]]
) -> Counted:
    """Return the counts of all rows, and the groups of samples."""
    description = {
        "title": recipe.title,
        "question": recipe.question,
        "labels": recipe.test.labels,
        "headline": msgspec.to_builtins(recipe.headline),
        "compare": [list(pair) for pair in recipe.pairs],
        "over": {row.name: row.over and list(row.over) for row in recipe.rows},
    }
    counts: dict[str, dict[str, Any]] = {}
    for name, cells in rows.items():
        counts[name] = {seed: (cell.notes or {})["counts"] for seed, cell in cells.items()}
    counts_of_a_row = next(iter(counts.values()))
    counts_of_a_seed = next(iter(counts_of_a_row.values()))
    tokens = sorted(counts_of_a_seed[HIDDEN])
    groups = {ALL: tokens}
    scenarios = [scenario_of(token) for token in tokens]
    for name, where in recipe.groups.items():
        matches = set(_matching_scenarios(dataset, where, scenarios, recipe, f"groups.{name}"))
        groups[name] = [token for token in tokens if scenario_of(token) in matches]
    attributes = sample_attributes(dataset, tokens) if recipe.by else {}
    for by in recipe.by:
        values = tokens_by_value(attributes, by)
        for value in sorted(values, key=natural_order):
            groups[f"{by}={value or 'unknown'}"] = values[value]
    return counted_of(counts, groups, description)
