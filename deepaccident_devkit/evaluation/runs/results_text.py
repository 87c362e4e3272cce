"""`results_text`: what a results file holds, for people."""

from __future__ import annotations

import json
from collections import Counter

from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.selection import agent_of, scenario_of


def results_text(results: Results) -> str:
    """A few aligned lines: whose predictions, of which samples, in which form."""
    tokens = results.tokens
    agents = Counter(agent_of(token) for token in tokens)
    lines = {
        "results": f"{results.task}, {results.path}",
        "fingerprint": results.fingerprint,
        "samples": f"{len(tokens)} of {len({scenario_of(token) for token in tokens})} scenarios",
        "agents": ", ".join(f"{name} {count}" for name, count in sorted(agents.items())),
        "meta": json.dumps(results.meta, ensure_ascii=False),
    }
    form = results.form
    if form is not None:
        lines["form"] = (
            f"{form.stored}, up to {form.predictions} predictions of {form.frames} frames, {form.step:g} s apart, "
            f"cells x {form.grid.x}, y {form.grid.y}, orientation {form.grid.orientation}, labels {form.labels}"
        )
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}".rstrip() for name, text in lines.items())
