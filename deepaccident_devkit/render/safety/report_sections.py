"""The sections of the safety report, each from one part of it; all text is escaped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.render.markup import Markup, facts, joined, table, tag
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.render.safety.accident_table import actor_words
from deepaccident_devkit.safety import COALITIONS, OUTCOMES, PARTNERS, OutcomeShares, SafetyReport
from deepaccident_devkit.safety.lead_times import CAVEAT
from deepaccident_devkit.safety.reports import number_text

_LEADS: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""Seconds of warning that the tables have columns for."""
_WARNED: Final = {
    "ego": "the ego is warned and brakes",
    "both": "both are warned and brake",
    "first": "the first is warned and brakes",
    "second": "the second is warned and brakes",
}
_LISTED: Final = 10
"""Rows of the tables of the largest and the least."""


def header(report: SafetyReport) -> Markup:
    """What was looked at, and how much of it."""
    avoidability = report.avoidability
    return facts(
        {
            "release": f"{report.version}, {report.dataroot}",
            "scenarios": f"{report.scenarios:,}, {report.ledger.without_accident:,} without an accident",
            "accidents": f"{len(report.rows):,}, {len(avoidability.accidents):,} of them replayed",
            "left out": f"{len(avoidability.dropped):,} not shown by their recording, {len(avoidability.skipped):,} "
            f"without meta or labels, {len(report.broken):,} broken",
            "observed": report.ledger.rule.text,
            "devkit": __version__,
        }
    )


def avoided(report: SafetyReport) -> Markup:
    """Shares of accidents that braking avoids, by the seconds of warning: a table for each group and who is warned."""
    shares = report.avoidability.shares
    if not shares:
        return tag("p", "No accident can be replayed.")
    order = list(_WARNED)
    shares.sort(key=lambda each: order.index(each.warned))  # stable: groups stay in their order
    first = shares[0].group
    notes = (
        "Share of accidents without a contact until 3 s after the recording, if the warned brake after the reaction; "
        "the others go on as recorded. Small: the share that is hit only after the end of the recording."
    )
    tables = (
        tag(
            "details",
            tag("summary", f"{each.group}: {_WARNED[each.warned]} ({each.accidents.max():,} accidents)"),
            _share_table(each),
            **({"open": ""} if each.group == first and each.warned in ("ego", "both") else {}),
        )
        for group in dict.fromkeys(each.group for each in report.avoidability.shares)
        for each in shares
        if each.group == group
    )
    return joined([tag("p", notes), *tables])


def _share_table(shares: OutcomeShares) -> Markup:
    columns = [(lead, round(lead * 10)) for lead in _LEADS if round(lead * 10) < len(shares.leads)]
    rows = [
        [
            f"reaction {braking.reaction:g} s, {braking.deceleration:g} m/s²",
            *(_share(shares, place, column) for _, place in columns),
        ]
        for column, braking in enumerate(shares.brakings)
    ]
    counts = ["accidents recorded for so long", *(f"{shares.accidents[place]:,}" for _, place in columns)]
    return table(["warned before the end (s)", *(f"{lead:g}" for lead, _ in columns)], [*rows, counts])


def _share(shares: OutcomeShares, place: int, column: int) -> Markup:
    share, later = shares.shares[place, column, OUTCOMES.index("avoided")], shares.extrapolated[place, column]
    after = [tag("span", f"{100 * later:.0f} % later", class_="interval later")] if later else []
    return joined([f"{100 * share:.0f} %", *after])


def lead_times(report: SafetyReport) -> Markup:
    """Mean leads of the sets of agents, and what each partner adds."""
    ledger = report.ledger
    if not ledger.accidents:
        return tag("p", "There is no accident whose lead times can be told.")
    means = zip(PARTNERS, ledger.mean_gains, ledger.mean_losses, ledger.mean_shapley, strict=True)
    partners = [[short_name(name), *(mean.text for mean in each)] for name, *each in means]
    sets = [
        [", ".join(map(short_name, agents)), mean.text, f"{mean.accidents:,}"]
        for agents, mean in zip(COALITIONS, ledger.mean_leads, strict=True)
    ]
    words = f"Mean lead: the ego alone {ledger.mean_leads[0].text} s, all agents {ledger.mean_together.text} s."
    return joined(
        [
            tag("p", f"{words} In brackets: intervals of 95 %, bootstrap over accidents. {CAVEAT}"),
            table(["partner", "adds to the ego (s)", "all lose without (s)", "Shapley value (s)"], partners),
            tag("details", tag("summary", "all sets of agents"), table(["agents", "mean lead (s)", "accidents"], sets)),
        ]
    )


def margins(report: SafetyReport) -> Markup:
    """The self-check of the replays: the gaps at the last frame, which count as contact."""
    found = report.avoidability.margins
    if not found:
        return tag("p", "No accident was replayed.")
    largest = sorted(found, key=lambda scenario: -found[scenario])[:_LISTED]
    counts = [[name, f"{count:,}"] for name, count in report.avoidability.margin_counts.items()]
    words = "Without braking every replay must collide. The gap between the two at the last frame counts as contact."
    return joined(
        [
            tag("p", words),
            table(["gap at the last frame", "accidents"], counts),
            table(["the largest", "gap (m)"], [[each, number_text(found[each], 3)] for each in largest]),
        ]
    )


def critical(report: SafetyReport) -> Markup:
    """The normal recordings in which two come nearest to a collision."""
    rows = [
        [
            story.facts["scenario"],
            number_text(nearest["min_ttc"], 2),
            number_text(nearest["min_gap"], 2),
            " and ".join(map(actor_words, nearest["pair"])),
        ]
        for story in report.normal
        if (nearest := story.facts["nearest"]) is not None
    ]
    if not rows:
        return tag("p", "In no recording without a collision do two that move come near one.")
    words = f"Of {len(report.normal):,} normal recordings, those in which two that move come nearest to a collision."
    heading = ["scenario", "least TTC (s)", "least gap (m)", "pair"]
    return joined([tag("p", words), table(heading, rows[:_LISTED])])


def torn(report: SafetyReport) -> Markup:
    """The twins of which each is in another split."""
    found = report.twins.torn
    if not found:
        return tag("p", "None: the split keeps all twins together.")
    rows = [[each.scenarios[0], each.splits[0], each.scenarios[1], each.splits[1]] for each in found]
    words = "What is learnt from one of two twins is known of the other. They should be in one split."
    return joined([tag("p", words), table(["scenario", "split", "twin", "its split"], rows)])


def left_out(report: SafetyReport, failed: Sequence[tuple[str, str]]) -> Markup:
    """What is not in the numbers above, and why; `failed` are scenarios without a replay and why."""
    rows = list(_left_out_rows(report, failed))
    return table(["scenario", "left out of", "why"], rows) if rows else tag("p", "Nothing.")


def _left_out_rows(report: SafetyReport, failed: Sequence[tuple[str, str]]) -> Iterator[list[str]]:
    for scenario, part, reason in report.left_out:
        yield [scenario, part, reason]
    for scenario, reason in failed:
        yield [scenario, "replay pages", reason]
