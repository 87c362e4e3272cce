"""The sections of a report that ask whether its numbers mean what they seem to: sanity, and what each choice does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from deepaccident_devkit.evaluation.headlines import value_text
from deepaccident_devkit.render.evaluation.markup import Markup, joined, scalar, table, tag

_SIDES: Final = {"empty": "nothing predicted", "given": "given", "perfect": "perfect"}


def sanity(report: Mapping[str, Any]) -> Markup:
    """What a sanity check says.

    Args:
        report: as `SanityReport.as_dict` has it.
    """
    rows = [
        [name, *(value_text(report[side][name], unit) for side in _SIDES)] for name, unit in report["units"].items()
    ]
    looked = [
        [each["name"], _share(each["given"]), _share(each["score"]), scalar(each["suspected"]), each["description"]]
        for each in report["candidates"]
    ]
    found = [tag("p", each, class_="warning") for each in report["warnings"]]
    heading = ["mistake", "fits as given", "fits set right", "suspected", "what it is"]
    return joined(
        [
            table(["number", *_SIDES.values()], rows, f"of {report['samples']:,} samples"),
            *(found or [tag("p", "Nothing looks wrong with the predictions.")]),
            tag("details", tag("summary", "All that was looked for"), table(heading, looked)),
        ]
    )


def explanation(report: Mapping[str, Any]) -> Markup:
    """What the other protocols, and each choice made otherwise, do to the headline numbers.

    Args:
        report: as `Explanation.as_dict` has it.
    """
    units, chosen = report["units"], report["chosen"]
    others = {name: values for name, values in report["protocols"].items() if name != report["protocol"]}
    protocols = {f"{report['protocol']} (chosen)": chosen, **others}
    rows = [
        [name, *(value_text(values.get(name), unit) for values in protocols.values())] for name, unit in units.items()
    ]
    changes: dict[str, dict[str, Markup]] = {}
    for each in report["numbers"]:
        told = changes.setdefault(each["choice"], {})
        if each["changed"]:
            told[each["headline"]] = _change(each, units[each["headline"]])
    shown = [name for name in units if any(name in told for told in changes.values())]
    same = [choice for choice, told in changes.items() if not told]
    otherwise = [[choice, *(told.get(name, "") for name in shown)] for choice, told in changes.items() if told]
    refused = [tag("li", tag("b", name), f": {why}") for name, why in report["refused"].items()]
    return joined(
        [
            table(["number", *protocols], rows, f"by protocol, of {report['samples']:,} samples"),
            table(["choice", *shown], otherwise, "one choice made otherwise, all else as chosen") if otherwise else "",
            tag("p", f"No number changes with: {', '.join(same)}.") if same else "",
            tag("details", tag("summary", "What these results cannot be evaluated by"), tag("ul", *refused))
            if refused
            else "",
        ]
    )


def _change(number: Mapping[str, Any], unit: Any) -> Markup:
    change = number["change"]
    below = [] if change is None else [tag("div", value_text(change, unit, signed=True), class_="interval")]
    return joined([value_text(number["value"], unit), *below])


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
