"""Write docs/scenarios.md from the fields of scenario files and the designs: `python docs/make_scenarios_page.py`."""

from pathlib import Path

from deepaccident_devkit.synth.spec import design_text, designs_text, field_tables

PAGE = Path(__file__).parent / "scenarios.md"

_HEAD = """# Scenario files: your own accidents

For everybody who writes their own synthetic scenarios: the fields of a scenario file, and the twelve designs as files.
13 minutes.

`deepaccident synth` makes the paper's twelve accidents. Each is a small YAML file; you can write your own:

```yaml
# mine.yaml: a van turns left in front of ego, in the rain
actors:
  - {role: ego, from: west, max_speed: [8, 12]}
  - {role: other, category: van, from: east, turn: left, ignores: [priority]}
meet: {actors: [ego, other]}
weather: [SoftRain, HardRain]
```

    deepaccident synth OUT --design mine.yaml --scenarios 8   # four accidents and their normal twins

Each pair is another draw from the file. In Python:

```python
import numpy as np
from deepaccident_devkit.synth.spec import draw, read_spec

template = read_spec("mine.yaml")
scenario = draw(template, np.random.default_rng(0))
print(scenario.weather, scenario.actor("ego").max_speed)
```

## What is drawn

- A number can be a range: `max_speed: [8, 12]`. Every number in the range is equally likely; both ends are possible.
- A word, a `true` or `false`, or a group such as `hump` can be a list: `from: [north, south]`. One item is drawn;
  an item that is listed twice is twice as likely. Four fields must have one value: `name`, `design`, `exchange` and
  `role`.
- Fields that a file does not name have their defaults. Of the lists `actors` and `ignores` all items are kept.
- Ego and other are required. The two behind them are in every scenario, named or not, because they are agents too.

## Arms, lanes and sides

![A junction from above: arms, the lanes' numbers, the sides of the south arm, distances](images/scenario_sketch.png)

- A vehicle `from: south` comes by the south arm and drives north. Traffic keeps right; lane 0 is the rightmost lane.
- `side` is as a driver towards the junction sees it. So on the south arm `right` is in the east; on the west arm,
  `right` is in the south.
- A `start_distance` ends at the middle of the junction. That of a vehicle is measured along its path.
- A parked vehicle stands in the free slot nearest to its `start_distance`. Slots are 5.8 m long, from about 20 m to
  110 m. So of two vehicles at 30 and 31 m the second one stands in another slot, a few metres away.

## What happens

- A three-way junction has no north arm. With traffic lights, the two roads have green by turns. Without lights, the
  vehicles from the south and the north give way to those on the road from west to east. A vehicle that turns left gives
  way to oncoming traffic.
- The actors of `meet` are timed so that both come to the crossing of their paths, the second `offset` seconds later.
  In the accident they see each other too late, obey neither lights nor priority, and all others let them go first. The
  one of the two that does not ignore `signal` has green.
- If the two miss each other, all values are drawn again. After 40 draws the command stops. Its message says how near
  they came, and which fields to change.
- All others obey the rules, except those in their `ignores`. Who ignores `signal` drives at red; `priority`, gives way
  to nobody.
- Cyclists and pedestrians are no agents: give them the role `background` or `pedestrian`, and write for example
  `meet: {actors: [ego, background]}`. `other` must still be there: it is one of the five that record.
- The recording ends with the collision; without one, when ego is 25 m past the middle of the junction, or after 10 s. It
  has 40 frames (4 s) or more. `--frames N` keeps the last N.
- The normal twin has the same scene and the same road users, but all of them pay attention and obey all rules.
- A file without `meet` gives only normal scenarios.

The message for a mistake names file, line and field:

    mine.yaml:4: actors[1].turn: expected one of straight, left, right, found 'lef'; did you mean 'left'?

Files are read with PyYAML's safe loader, without tags and aliases. Numbers are decimal.

## Look at it

The first pair, without sensors:

    deepaccident synth OUT --design mine.yaml --scenarios 2 --sensors none
    deepaccident safety describe OUT
    deepaccident render accident OUT --layers boxes --out countdown.png

`safety describe` says who hits whom, when, how fast and with which sides. The picture shows the boxes at four moments,
in the agents' cameras and from above. All commands together take about 20 seconds on two cores. With camera images it
takes about a minute for the last 25 frames of one accident:

    deepaccident synth OUT --design mine.yaml --scenarios 1 --frames 25
    deepaccident render accident OUT --out countdown.png

## Four to begin with

A pedestrian steps onto the road between parked cars, in front of ego:

```yaml
# pedestrian.yaml
road: {signalized: false}
actors:
  - {role: ego, from: west, max_speed: [7, 10]}
  - {role: other, category: van, from: east, max_speed: [6, 9]}
  - {role: pedestrian, from: west, side: right, start_distance: [15, 25], max_speed: [1, 2]}
  - {role: parked, from: west, start_distance: 28}
  - {role: parked, category: van, from: west, start_distance: 34}
meet: {actors: [ego, pedestrian], offset: [-0.2, 0.2]}
background: {vehicles: [3, 6], walking: 8}
weather: [Clear, SoftRain]
time_of_day: [Noon, Sunset]
```

A rear-end collision. Vehicles that begin in the same lane keep their distance, so here a slow van changes into ego's
lane, and ego comes there 0.7 s later:

```yaml
# rear_end.yaml
road: {lanes: 2}
actors:
  - {role: ego, from: west, lane: 1, max_speed: [12, 14]}
  - {role: other, category: van, from: west, lane: 0, lane_change: 60, max_speed: [5, 6]}
meet: {actors: [other, ego], offset: 0.7}
```

A right hook: ego turns right across the path of a cyclist in the lane beside it. Ego turns from the left lane here,
because vehicles in one lane only follow each other:

```yaml
# right_hook.yaml
road: {signalized: false, lanes: 2}
actors:
  - {role: ego, from: west, lane: 1, turn: right, max_speed: [8, 10]}
  - {role: other, from: east, max_speed: [7, 10]}
  - {role: background, category: cyclist, from: west, lane: 0, max_speed: [3, 6]}
meet: {actors: [ego, background]}
```

A normal scenario, in which nobody is timed to meet:

```yaml
# quiet.yaml
road: {kind: three-way, signalized: false}
actors:
  - {role: ego, from: south, turn: left}
  - {role: other, from: east}
background: {vehicles: 4, two_wheelers: 2}
weather: Cloudy
```

## The twelve designs

![The twelve designs, from above and 0.7 s before the impact](images/designs.jpg)

    deepaccident synth --show-design all
    deepaccident synth --show-design 3 > mine.yaml             # a file to begin with
    deepaccident synth OUT --design 3 --design 9               # only these

"""

_FIELDS = """
A full example is design 3:

"""


def page() -> str:
    """The text of the page."""
    parts = [_HEAD, _indented(designs_text()), _FIELDS, f"```yaml\n{design_text(3)}```\n\n## All fields\n"]
    for path, entries in field_tables().items():
        parts.append(f"\n### {f'`{path}`' if path else 'The file'}\n\n")
        parts.append("| field | can be | if not given | meaning |\n|---|---|---|---|\n")
        parts += [f"| `{e.key}` | {e.values} | {e.default} | {e.meaning} |\n" for e in entries]
    return "".join(parts)


def _indented(text: str) -> str:
    return "".join(f"    {line}\n" for line in text.splitlines())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
