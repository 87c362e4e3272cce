"""Write docs/glossary.md from the table of human names: `python docs/make_glossary.py`."""

from collections.abc import Iterator
from pathlib import Path

from deepaccident_devkit.evaluation.runs.setups import TASKS
from deepaccident_devkit.evaluation.task import Row
from deepaccident_devkit.support.human_names import human_name, name_tables
from deepaccident_devkit.taxonomy import AGENTS, short_name

PAGE = Path(__file__).parent / "glossary.md"
_ARROWS = {"higher": "↑", "lower": "↓", "neither": ""}

_HEAD = """# Glossary

For everyone who meets an unknown word in the devkit.
`python docs/make_glossary.py` makes this page from the table of names.

## Words

- **actor**: a road user in the labels
- **agent**: one of the five recorders
- **alarm**: one predicted accident
- **annotation**: one box of one label
- **baseline**: a predictor without a learned model
- **bundle**: folder that an evaluation writes
- **cluster, scenario pair**: an accident and its twin, counted as one
- **colliding pair**: the two actors that collide
- **delta-v**: a vehicle's change of velocity in the impact
- **DRAC**: deceleration that just avoids a collision
- **ego**: agent that recorded the sample
- **frame**: a moment of a scenario, or a coordinate system
- **heads**: raw maps of a model
- **headline**: a metric that is shown first
- **horizon**: how far a model looks ahead
- **impact**: the moment of the collision, the recording's last frame
- **label, meta, calib**: the files of boxes, scenario facts and poses
- **lead time**: from when agents see both colliders to the impact
- **link**: the radio between agents, with latency, pose noise and packet loss
- **partner**: an agent that sends its data to ego
- **PET**: time between one actor leaving a place and another arriving
- **protocol, switch**: the rules of a metric, and one choice in them
- **release**: a folder in DeepAccident's format
- **sample**: one agent at one frame
- **scenario**: one recording
- **scope**: whether only accidents are evaluated, or all scenarios
- **Shapley value**: what a partner adds, averaged over all orders of joining
- **track**: one actor at one frame, merged from all labels
- **TTA, mTTA**: time from the first alarm to the impact, and its mean
- **TTC**: time to collision at constant velocity
- **twins**: accident and normal scenario with the same traffic

"""


def page() -> str:
    """Return the page's text."""
    return _HEAD + "\n".join([*_agent_lines(), "", *_protocol_lines(), "", *_metric_lines(), ""])


def metric_identifier(row: Row) -> str:
    """Return the last part of the path of a number that is not `*`, such as `pq`."""
    return next(part for part in reversed(row.path.split("/")) if part != "*")


def _agent_lines() -> Iterator[str]:
    yield from ("## Agents", "", "| name | short | identifier |", "|---|---|---|")
    for agent in AGENTS:
        yield f"| {human_name(agent)} | {short_name(agent)} | `{agent}` |"


def _protocol_lines() -> Iterator[str]:
    yield from ("## Protocols", "", "[The rules](protocols.md) of each protocol.", "")
    yield from ("| task | `--protocol` |", "|---|---|")
    for task, evaluator in TASKS.items():
        protocols = [f"`{name}`" for name in evaluator.protocols]
        yield f"| {human_name(task, 'tasks')} | {', '.join(protocols)} |"


def _metric_lines() -> Iterator[str]:
    """Yield a table of each task's headline metrics."""
    yield from ("## Metrics", "", "An arrow after the unit points in the better direction.", "")
    metrics = name_tables()["metrics"]
    for task, evaluator in TASKS.items():
        yield from (f"### {human_name(task, 'tasks').capitalize()}", "")
        yield from ("| metric | identifier | unit | meaning |", "|---|---|---|---|")
        shown = set()
        for row in evaluator.result_class.rows:
            identifier = metric_identifier(row)
            if not row.is_headline or identifier in shown:
                continue
            shown.add(identifier)
            name, meaning = metrics[identifier]
            unit = f"{row.unit.replace(' - ', ' − ')} {_ARROWS[row.better]}".rstrip()
            yield f"| {name} | `{identifier}` | {unit} | {meaning} |"
        yield ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
