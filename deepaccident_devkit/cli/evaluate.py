"""`deepaccident evaluate` and `deepaccident check results`: metrics and checks of results files."""

import json
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

import click

from deepaccident_devkit.cli.agents import agent_names, agents_parameter
from deepaccident_devkit.cli.options import (
    DATAROOT,
    PATH,
    engine_of,
    engine_parameters,
    figure_style_parameter,
    json_parameter,
    on_error_parameter,
    open_release,
    refuse_unused,
    release_of,
    release_parameters,
    switches_of,
    version_parameter,
)
from deepaccident_devkit.cli.verbs import (
    LazyVerbs,
    WordChoice,
    advanced,
    field_option,
    together,
    verb,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES, EVERYTHING, attribute_name
from deepaccident_devkit.evaluation.intervals import MOST_RESAMPLES
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    breakdowns_of,
    checked_target,
    coverage,
    default_selection,
    evaluate_results,
    evaluation_store,
    read_bundle,
    results_text,
    save_run,
    summary_text,
)
from deepaccident_devkit.evaluation.runs.bundles import Chooser, chosen_threshold
from deepaccident_devkit.evaluation.runs.further import extra_result, with_further
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import (
    TASKS,
    EvaluationSetup,
    SampleList,
    ScopeName,
    check_recordings,
    evaluator_class,
    label_rules,
)
from deepaccident_devkit.evaluation.runs.text import SHOWN_BREAKDOWNS
from deepaccident_devkit.evaluation.warning import CleanWarnings, FieldWarnings
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.release.store import Dataroot
from deepaccident_devkit.support.parallel import workers_kept
from deepaccident_devkit.support.plugins import LazyVerb, Plugin
from deepaccident_devkit.taxonomy import AGENTS

_FINDINGS_STATUS = 1
# Exit status of a check that had nothing to compare.
_NOTHING_STATUS = 2
_RELEASE_OPTIONS = ("version", "split", "samples", "scope", "agents", "horizon", "on_error")
_selection_parameters = together(
    click.option(
        "--split",
        default="val",
        show_default=True,
        help="train, val, test, train_mini, val_mini, all (every scenario that is here), or a "
        "split file (.txt).",
    ),
    click.option(
        "--samples",
        type=WordChoice(get_args(SampleList)),
        help="evaluate: samples within the horizon before the end. all: two samples per second of "
        "each scenario.  [default: evaluate; for warnings, planning and forecasting: all]",
    ),
    click.option(
        "--scope",
        type=WordChoice(get_args(ScopeName)),
        help="Accident scenarios only, or all scenarios.  [default: accident; with --samples all: "
        "all]",
    ),
    agents_parameter,
    click.option(
        "--horizon",
        default=2.0,
        show_default=True,
        help="How many seconds the predictions look ahead.",
    ),
)


_WARNING_OPTIONS = together(
    click.option(
        "--threshold-from",
        type=PATH,
        help="Folder with an evaluation on another split; it sets the alarm threshold (protocol "
        "clean only).",
    ),
    advanced(
        "--threshold-by",
        type=WordChoice(get_args(Chooser)),
        default="best_f1",
        show_default=True,
        help="best_f1: the threshold with the best F1. quiet: at most one second of false alarm "
        "per minute. braking: at most one second of braking for false alarms per minute, "
        "found by an evaluation with --prevented.",
    ),
    click.option(
        "--prevented",
        is_flag=True,
        help="Also compute which accidents a braking driver would have avoided after the alarm, "
        "and how much braking the false alarms cause (protocol clean only).",
    ),
)


def _attributes(
    context: click.Context, parameter: click.Parameter, names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the attributes in repeated --by."""
    try:
        return tuple(map(attribute_name, names))
    except ChoiceError as error:
        raise click.BadParameter(str(error), context, parameter) from error


def _task_verb(task: str) -> click.Command:
    """Return the verb of a task."""
    evaluator = evaluator_class(task)
    protocols = list(evaluator.protocols)
    text = (
        f"{evaluator.description}\n\n"
        "The predictions are compared with the labels of the release in DATAROOT."
    )

    @verb(task, help=text)
    @release_parameters
    @click.option(
        "--results", required=True, type=PATH, help="Results file or folder with the predictions."
    )
    @_selection_parameters
    @click.option(
        "--protocol",
        type=WordChoice(protocols, label_rules(task)),
        default=protocols[0],
        show_default=True,
        help="Rules of the metrics; docs/protocols.md describes them.",
    )
    @(_WARNING_OPTIONS if task == "warning" else together())
    @advanced(
        "--switch",
        "switches",
        multiple=True,
        metavar="NAME=VALUE",
        help="Change one field of the protocol; you can repeat this option.",
    )
    @advanced(
        "--allow-partial",
        is_flag=True,
        help="Accept results that lack some samples (which marks every number as partial), or "
        "leave out predictions of other samples.",
    )
    @click.option(
        "--by",
        multiple=True,
        callback=_attributes,
        metavar="NAME",
        help="Also give the numbers for each value of this attribute; you can repeat this option. "
        f"One of {', '.join(ATTRIBUTES)}.",
    )
    @field_option(Resampling, "resamples", option=advanced, type=click.IntRange(0, MOST_RESAMPLES))
    @click.option(
        "--sanity",
        is_flag=True,
        help="Look for classic mistakes, such as mirrored axes or another frame. Exit status 2: "
        "there is nothing to compare.",
    )
    @click.option(
        "--out", type=PATH, help="Folder to write all numbers, figures and a report into."
    )
    @click.option(
        "--overwrite", is_flag=True, help="Replace an evaluation that is already in --out."
    )
    @figure_style_parameter
    @advanced(
        "--include-results",
        is_flag=True,
        help="Copy the results into --out, so that others can verify them.",
    )
    @json_parameter
    def evaluate_task(
        results: Path, protocol: str, switches: tuple[str, ...], **options: Any
    ) -> None:
        setup = EvaluationSetup(
            task=task, protocol=protocol, switches=switches_of(switches), horizon=options["horizon"]
        )
        _evaluate(setup, results, **options)

    return evaluate_task


@workers_kept()
def _evaluate(
    setup: EvaluationSetup, results: Path, *, by: tuple[str, ...], as_json: bool, **options: Any
) -> None:
    out: Path | None = options["out"]
    _refuse_unused(setup, options)
    selection = _selection_of(setup, options)
    opened = read_results(results)
    requested = {
        **selection.as_dict(),
        "task": setup.task,
        "protocol": setup.protocol,
        "results": str(opened.path),
    }
    if out is not None:  # before the release is indexed
        checked_target(out, overwrite=options["overwrite"], requested=requested)
    dataset = open_release(**release_of(options), **engine_of(options))
    if options.get("threshold_from") is not None:
        threshold = chosen_threshold(
            options["threshold_from"], options["threshold_by"], selection.tokens(dataset)
        )
        setup = replace(setup, switches={**setup.switches, "threshold": threshold})
    texts = {
        name: str(value) for name, value in options.items() if name not in ("workers", "executor")
    }
    command = digest_of(
        {"setup": setup.as_dict(), "results": opened.fingerprint, "by": by, "options": texts}
    )
    with nullcontext() if out is None else evaluation_store(out, command).shared() as turn:
        if out is not None:  # another process may just have finished
            checked_target(out, overwrite=options["overwrite"])
        run = evaluate_results(
            dataset,
            opened,
            setup,
            selection,
            allow_partial=options["allow_partial"],
            out=out,
            progress=True,
            **engine_of(options),
        )
        if turn is None or out is None or turn.alone():
            summary, text = _complete(run, dataset, opened, by, options)
        else:  # another process with the same command has written it
            summary, text = read_bundle(out).summary, ""
    if as_json:
        click.echo(json.dumps(summary, indent=1))
    else:
        click.echo(f"{summary_text(summary, by or SHOWN_BREAKDOWNS)}\n\n{text}".strip())
    if out is not None:
        click.echo(f"written: {out}", err=as_json)
    if options["sanity"] and not summary["sanity"]["sought"]:
        sys.exit(_NOTHING_STATUS)


def _complete(
    run: EvaluationRun,
    dataset: DeepAccident,
    results: Results,
    by: tuple[str, ...],
    options: dict[str, Any],
) -> tuple[Mapping[str, Any], str]:
    """Complete a run, and save it if requested.

    Returns:
        Its summary, and the text of the sanity check.
    """
    engine = engine_of(options)
    resampling = Resampling(resamples=options["resamples"])
    run = run.broken_down(
        (EVERYTHING, *(by or breakdowns_of(run.setup.task))), resampling, **engine
    )
    if options.get("prevented"):
        run = with_further(run, "prevented", dataset, resampling, progress=True, **engine)
    text = ""
    if options["sanity"]:
        sanity = check_sanity(dataset, results, run.setup, sorted(run.evaluator.tokens), **engine)
        if run.partial is not None:
            text = f"{run.partial.text()}\n"
        run, text = replace(run, sanity=sanity.as_dict()), f"{text}{sanity.to_text()}"
    if options["out"] is not None:
        from deepaccident_devkit.render.evaluation import save_report

        report = partial(save_report, run, dataset=dataset, results=results)
        save_run(
            run,
            options["out"],
            include_results=options["include_results"],
            overwrite=options["overwrite"],
            extras=[report],
        )
    return run.summary(), text


def _refuse_unused(setup: EvaluationSetup, options: dict[str, Any]) -> None:
    """Raise a usage error for an option that changes nothing here, or that needs another one."""
    if options["out"] is None:
        refuse_unused("without --out", "overwrite", "include_results", "style")
    if options.get("threshold_from") is None:
        refuse_unused("without --threshold-from", "threshold_by")
    elif "threshold" in setup.switches:
        raise click.UsageError(
            "--threshold-from sets the threshold that --switch threshold=… sets; give one of them"
        )
    if options.get("prevented"):
        if not isinstance(setup.rules, CleanWarnings):
            raise click.UsageError(
                "--prevented needs the scores of whole recordings, which --protocol "
                f"{setup.protocol} does not have; give --protocol clean"
            )
        extra_result("prevented")  # before long work, as its plug-in may be missing
    if isinstance(setup.rules, FieldWarnings) and options["resamples"]:
        refuse_unused("with --protocol field, which has no intervals", "resamples")
    if (
        not evaluator_class(setup.task).has_horizon
        and _selection_of(setup, options).samples == "all"
    ):
        why = "the protocol has its own"
        if setup.task == "detection":
            why = "detections are of the present"
        refuse_unused(f"with --samples all: {why}", "horizon")


def _selection_of(setup: EvaluationSetup, options: Mapping[str, Any]) -> SampleSelection:
    """Return the samples that a verb's options select."""
    agents = agent_names(options["agents"])
    return default_selection(
        setup,
        options["split"],
        samples=options["samples"],
        scope=options["scope"],
        agents=None if agents == AGENTS else agents,
    )


@verb("results")
@click.argument("results", type=PATH)
@click.option(
    "--dataroot", type=DATAROOT, help="Also compare the samples with those of this release."
)
@version_parameter
@_selection_parameters
@engine_parameters
@on_error_parameter
def check_results(results: Path, dataroot: Dataroot | None, version: str, **options: Any) -> None:
    """Check every entry of the results file or folder RESULTS, and print a summary.

    With --dataroot, also look for the mistakes of `evaluate … --sanity`.
    Exit status 1: with --dataroot, samples of --split are missing, or RESULTS has others. 2: an
    entry is wrong, or there is nothing to compare.
    """
    if dataroot is None:
        refuse_unused("without --dataroot", *_RELEASE_OPTIONS)
    opened, engine = read_results(results), engine_of(options)
    opened.check(**engine, progress=True)
    click.echo(results_text(opened))
    if dataroot is None:
        return
    dataset = open_release(dataroot, version=version, on_error=options["on_error"], **engine)
    protocol = next(iter(evaluator_class(opened.task).protocols))
    if opened.task == "accident":
        protocol = "boxes"  # the protocol that takes explicit accidents
    setup = EvaluationSetup(task=opened.task, protocol=protocol, horizon=options["horizon"])
    selection = _selection_of(setup, options)
    check_recordings(opened, dataset)
    covered = coverage(dataset, opened.tokens, selection)
    click.echo(f"{selection.text()}: {covered.to_text()}")
    shared = sorted(set(opened.tokens).intersection(selection.tokens(dataset)))
    sanity = check_sanity(dataset, opened, setup, shared, **engine)
    click.echo(sanity.to_text())
    if not sanity.sought:
        sys.exit(_NOTHING_STATUS)
    if not covered.is_complete:
        sys.exit(_FINDINGS_STATUS)


def _compare() -> click.Command:
    # here, since it draws, and so imports matplotlib
    from deepaccident_devkit.cli.evaluate_bundles import compare

    return compare


def _task_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the verbs of a plug-in's tasks."""
    return {
        name: LazyVerb(task.summary, partial(_task_verb, name))
        for name, task in plugin.tasks.items()
    }


_VERBS: Final = {
    **{name: LazyVerb(task.description, partial(_task_verb, name)) for name, task in TASKS.items()},
    "compare": LazyVerb("Compare two evaluations, and test the differences.", _compare),
}


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_task_verbs)
def evaluate() -> None:
    """Evaluate results files; compare evaluations."""
