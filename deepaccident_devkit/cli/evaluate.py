"""`deepaccident evaluate` and `deepaccident check results`: metrics and checks of results files."""

import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from deepaccident_devkit.cli.agents import agent_names, agents_parameter
from deepaccident_devkit.cli.options import (
    DATAROOT,
    PATH,
    engine_options,
    engine_parameters,
    figure_style_parameter,
    json_parameter,
    on_error_parameter,
    open_release,
    parse_switches,
    refuse_unused,
    release_of,
    release_parameters,
    version_parameter,
)
from deepaccident_devkit.cli.verbs import (
    Function,
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
from deepaccident_devkit.evaluation.intervals import MAX_RESAMPLES
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
from deepaccident_devkit.support.parallel import keep_workers
from deepaccident_devkit.support.plugins import LazyVerb, Plugin
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS

_FINDINGS_STATUS = 1
# Exit status of a check without anything to compare.
_NOTHING_STATUS = 2
_RELEASE_OPTIONS = ("version", "split", "samples", "scope", "agents", "horizon", "on_error")


def _selection_parameters(task: str | None = None) -> Callable[[Function], Function]:
    """Make the options that select samples, with help for one task, or for all tasks if None."""
    samples_default = "evaluate; for warnings, planning and forecasting: all"
    horizon_help = "How many seconds the predictions look ahead."
    if task is not None:
        evaluator = evaluator_class(task)
        samples_default = "all" if evaluator.needs_whole_recordings else "evaluate"
        if not evaluator.has_horizon:
            horizon_help = (
                "With --samples evaluate: how many seconds before the end of a scenario its "
                "samples begin."
            )
    return together(
        click.option(
            "--split",
            default="val",
            show_default=True,
            help="Split to evaluate: train, val, test, train_mini, val_mini, all (every scenario "
            "in the release), or a split file (.txt).",
        ),
        click.option(
            "--samples",
            type=WordChoice(get_args(SampleList)),
            help="Samples to evaluate. evaluate: samples within the horizon before the end of a "
            f"scenario. all: two per second of each scenario.  [default: {samples_default}]",
        ),
        click.option(
            "--scope",
            type=WordChoice(get_args(ScopeName)),
            help="Evaluate only accident scenarios, or all scenarios.  [default: accident; with "
            "--samples all: all]",
        ),
        agents_parameter,
        click.option("--horizon", default=2.0, show_default=True, help=horizon_help),
    )


_WARNING_OPTIONS = together(
    click.option(
        "--threshold-from",
        type=PATH,
        help="Take the alarm threshold from the evaluation in this folder, which must be on "
        "another split (protocol clean only).",
    ),
    advanced(
        "--threshold-by",
        type=WordChoice(get_args(Chooser)),
        default="best_f1",
        show_default=True,
        help="How --threshold-from chooses the threshold. best_f1: the best F1. quiet: at most one "
        "second of false alarm per minute. braking: at most one second of braking for false alarms "
        "per minute, which needs an evaluation with --prevented.",
    ),
    click.option(
        "--prevented",
        is_flag=True,
        help="Also compute which accidents a braking driver would have avoided after the alarm, "
        "and how much braking the false alarms cause (protocol clean only).",
    ),
)


def _parse_attributes(
    context: click.Context, parameter: click.Parameter, names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the attributes passed with repeated --by."""
    try:
        return tuple(map(attribute_name, names))
    except ChoiceError as error:
        raise click.BadParameter(str(error), context, parameter) from error


def _make_task_verb(task: str) -> click.Command:
    """Build the subcommand that evaluates a task."""
    evaluator = evaluator_class(task)
    protocols = list(evaluator.protocols)
    text = (
        f"{evaluator.description}\n\n"
        "The command compares the predictions with the labels of the release in DATAROOT."
    )

    @verb(task, help=text)
    @release_parameters
    @click.option(
        "--results", required=True, type=PATH, help="Results file or folder with the predictions."
    )
    @_selection_parameters(task)
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
        help="Change one field of the protocol. You can repeat this option.",
    )
    @advanced(
        "--allow-partial",
        is_flag=True,
        help="Accept results with missing samples (the numbers are then marked as partial), and "
        "ignore predictions for samples outside the selection.",
    )
    @click.option(
        "--by",
        multiple=True,
        callback=_parse_attributes,
        metavar="NAME",
        help="Also print the numbers for each value of this attribute: "
        f"{', '.join(ATTRIBUTES)}. You can repeat this option.",
    )
    @field_option(Resampling, "resamples", option=advanced, type=click.IntRange(0, MAX_RESAMPLES))
    @click.option(
        "--sanity",
        is_flag=True,
        help="Look for classic mistakes, such as mirrored axes or a wrong frame. The command exits "
        "with 2 if there is nothing to compare.",
    )
    @click.option(
        "--out", type=PATH, help="Write all numbers, figures and a report into this folder."
    )
    @click.option(
        "--overwrite", is_flag=True, help="Replace an evaluation that already exists in --out."
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
            task=task,
            protocol=protocol,
            switches=parse_switches(switches),
            horizon=options["horizon"],
        )
        _evaluate(setup, results, **options)

    return evaluate_task


@keep_workers()
def _evaluate(
    setup: EvaluationSetup, results: Path, *, by: tuple[str, ...], as_json: bool, **options: Any
) -> None:
    out: Path | None = options["out"]
    _refuse_unused(setup, options)
    selection = _select_samples(setup, options)
    opened_results = read_results(results)
    requested = {
        **selection.as_dict(),
        "task": setup.task,
        "protocol": setup.protocol,
        "results": str(opened_results.path),
    }
    if out is not None:  # fails before the release is indexed
        checked_target(out, overwrite=options["overwrite"], requested=requested)
    dataset = open_release(**release_of(options), **engine_options(options))
    if options.get("threshold_from") is not None:
        threshold = chosen_threshold(
            options["threshold_from"], options["threshold_by"], selection.tokens(dataset)
        )
        setup = replace(setup, switches={**setup.switches, "threshold": threshold})
    option_texts = {name: str(value) for name, value in options.items()}
    for name in engine_options(options):  # workers do not affect the numbers
        del option_texts[name]
    command = digest_of(
        {
            "setup": setup.as_dict(),
            "results": opened_results.fingerprint,
            "by": by,
            "options": option_texts,
        }
    )
    with nullcontext() if out is None else evaluation_store(out, command).shared() as turn:
        if out is not None:  # another process may have finished in the meantime
            checked_target(out, overwrite=options["overwrite"])
        run = evaluate_results(
            dataset,
            opened_results,
            setup,
            selection,
            allow_partial=options["allow_partial"],
            out=out,
            progress=True,
            **engine_options(options),
        )
        if turn is None or out is None or turn.alone():
            summary, text = _complete_run(run, dataset, opened_results, by, options)
        else:  # another process with the same command has written the folder
            summary = read_bundle(out).summary
            text = ""
    if as_json:
        click.echo(json.dumps(summary, indent=1))
    else:
        click.echo(f"{summary_text(summary, by or SHOWN_BREAKDOWNS)}\n\n{text}".strip())
    if out is not None:
        click.echo(f"wrote {out}", err=as_json)
    if options["sanity"] and not summary["sanity"]["sought"]:
        sys.exit(_NOTHING_STATUS)


def _complete_run(
    run: EvaluationRun,
    dataset: DeepAccident,
    results: Results,
    by: tuple[str, ...],
    options: NamedValues,
) -> tuple[ReadOnlyValues, str]:
    """Add breakdowns and checks to a run, and save it if requested.

    Returns:
        Summary of the run, and the text of the sanity check.
    """
    engine = engine_options(options)
    resampling = Resampling(resamples=options["resamples"])
    attributes = by or breakdowns_of(run.setup.task)
    run = run.broken_down((EVERYTHING, *attributes), resampling, **engine)
    if options.get("prevented"):
        run = with_further(run, "prevented", dataset, resampling, progress=True, **engine)
    text = ""
    if options["sanity"]:
        sanity = check_sanity(dataset, results, run.setup, sorted(run.evaluator.tokens), **engine)
        if run.partial is not None:
            text = f"{run.partial.text()}\n"
        text += sanity.to_text()
        run = replace(run, sanity=sanity.as_dict())
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


def _refuse_unused(setup: EvaluationSetup, options: NamedValues) -> None:
    """Raise a usage error for an option that has no effect here, or that needs another option."""
    if options["out"] is None:
        refuse_unused("without --out", "overwrite", "include_results", "style", "no_title")
    if options.get("threshold_from") is None:
        refuse_unused("without --threshold-from", "threshold_by")
    elif "threshold" in setup.switches:
        raise click.UsageError(
            "--threshold-from and --switch threshold=… both set the threshold; give only one"
        )
    if options.get("prevented"):
        if not isinstance(setup.rules, CleanWarnings):
            raise click.UsageError(
                "--prevented needs scores of whole recordings, and --protocol "
                f"{setup.protocol} has none; use --protocol clean"
            )
        extra_result("prevented")  # before the long work, because its plug-in may be missing
    if isinstance(setup.rules, FieldWarnings) and options["resamples"]:
        refuse_unused("with --protocol field, which has no confidence intervals", "resamples")
    if evaluator_class(setup.task).has_horizon:
        return
    if _select_samples(setup, options).samples == "all":
        reason = "the protocol sets its own horizon"
        if setup.task in ("detection", "tracking"):
            reason = "boxes are only of the present"
        refuse_unused(f"with --samples all, as {reason}", "horizon")


def _select_samples(setup: EvaluationSetup, options: ReadOnlyValues) -> SampleSelection:
    """Return the selection of samples that a subcommand's options describe."""
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
@click.option("--dataroot", type=DATAROOT, help="Also compare with the samples of this release.")
@version_parameter
@_selection_parameters()
@engine_parameters
@on_error_parameter
def check_results(results: Path, dataroot: Dataroot | None, version: str, **options: Any) -> None:
    """Check every entry of the results file or folder RESULTS, and print a summary.

    With --dataroot, also look for the mistakes of `evaluate … --sanity`. The command then exits
    with 1 if samples of --split are missing, or if RESULTS has samples outside of it. It exits with
    2 if an entry is wrong, or if there is nothing to compare.
    """
    if dataroot is None:
        refuse_unused("without --dataroot", *_RELEASE_OPTIONS)
    opened_results = read_results(results)
    engine = engine_options(options)
    opened_results.check(**engine, progress=True)
    click.echo(results_text(opened_results))
    if dataroot is None:
        return
    dataset = open_release(dataroot, version=version, on_error=options["on_error"], **engine)
    task = opened_results.task
    protocol = next(iter(evaluator_class(task).protocols))
    if task == "accident":
        protocol = "boxes"  # the protocol for explicit accidents
    setup = EvaluationSetup(task=task, protocol=protocol, horizon=options["horizon"])
    selection = _select_samples(setup, options)
    check_recordings(opened_results, dataset)
    sample_coverage = coverage(dataset, opened_results.tokens, selection)
    click.echo(f"{selection.text()}: {sample_coverage.to_text()}")
    selected_tokens = selection.tokens(dataset)
    common_tokens = sorted(set(opened_results.tokens).intersection(selected_tokens))
    sanity = check_sanity(dataset, opened_results, setup, common_tokens, **engine)
    click.echo(sanity.to_text())
    if not sanity.sought:
        sys.exit(_NOTHING_STATUS)
    if not sample_coverage.is_complete:
        sys.exit(_FINDINGS_STATUS)


def _load_compare_verb() -> click.Command:
    # imported here because it draws, and so imports matplotlib
    from deepaccident_devkit.cli.evaluate_bundles import compare

    return compare


def _read_task_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the subcommands for a plug-in's tasks."""
    return {
        name: LazyVerb(task.summary, partial(_make_task_verb, name))
        for name, task in plugin.tasks.items()
    }


_VERBS = {
    **{
        name: LazyVerb(task.description, partial(_make_task_verb, name))
        for name, task in TASKS.items()
    },
    "compare": LazyVerb("Compare two evaluations, and test the differences.", _load_compare_verb),
}


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_read_task_verbs)
def evaluate() -> None:
    """Evaluate results files; compare evaluations."""
