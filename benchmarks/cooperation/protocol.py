"""The protocol of benchmarks/cooperation: what is made, trained and compared; committed before the first test run."""

from dataclasses import dataclass
from typing import Any, Final

from benchmarks.cooperation.rows import Row

HEADLINE: Final = (
    "IoU 100x100 on the test release, of the arm `all` with all agents less that of the arm `single` with the ego "
    "alone, after equally many steps, the model seeds pooled: cooperation wins if the 95 % interval of this difference "
    "over pairs of scenarios is above 0, loses if it is below 0, and else it is not decided"
)
HEADLINE_NUMBER: Final = "iou_100"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasePlan:
    """A generated release: `scenarios` of `designs` by turns, half of them normal twins, from one seed."""

    seed: int
    scenarios: int
    designs: tuple[int, ...]


SEEN_DESIGNS: Final = (1, 2, 6, 7, 12)
HELD_OUT: Final = 8
"""The design that no model sees before the test. In 3, 4, 5, 9, 10 and 11 no house can hide the collider."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """All that decides the numbers."""

    training: ReleasePlan = ReleasePlan(seed=101, scenarios=80, designs=SEEN_DESIGNS)
    tuning: ReleasePlan = ReleasePlan(seed=102, scenarios=12, designs=SEEN_DESIGNS)
    test: ReleasePlan = ReleasePlan(seed=103, scenarios=36, designs=(*SEEN_DESIGNS, HELD_OUT))
    frames: int = 40
    image_size: tuple[int, int] = (160, 90)
    seeds: tuple[int, ...] = (1, 2, 3)
    first_steps: int = 700
    """Of the ego alone, from random weights; both arms go on from there."""
    arm_steps: int = 350
    learning_rates: tuple[float, ...] = (3e-3, 6e-3)
    """One round: the first steps of the first seed with each rate, scored on the tuning release; the ego alone, so that
    the choice cannot favour cooperation."""
    tuning_samples: int = 120
    least_score: float = 0.01
    """If no run reaches it, scores say nothing yet, and the lowest loss of the last steps chooses."""
    egos: int | None = None
    configurations: tuple[str, ...] = ("+behind", "+other", "+infrastructure", "vehicles")
    """Who cooperates in the rows of one seed; so with the links."""
    pose_noises: tuple[float, ...] = (0.2, 0.5)
    latencies: tuple[float, ...] = (0.2, 0.5)
    costs: tuple[str, ...] = ("mean", "max", "disconet", "cobevt", "v2xvit", "4 s")
    """Fusions, and a horizon, whose seconds a step are measured; they are not trained."""
    cost_steps: int = 5
    headline: str = HEADLINE
    resamples: int = 1000


PROTOCOL: Final = Protocol()
SMOKE: Final = Protocol(
    training=ReleasePlan(seed=101, scenarios=2, designs=(1,)),
    tuning=ReleasePlan(seed=102, scenarios=4, designs=(1,)),
    test=ReleasePlan(seed=103, scenarios=4, designs=(1, HELD_OUT)),
    frames=7,
    image_size=(64, 36),
    seeds=(1,),
    first_steps=4,
    arm_steps=2,
    learning_rates=(1e-3, 2e-3),
    tuning_samples=1,
    egos=1,
    configurations=("+other",),
    pose_noises=(),
    latencies=(0.1,),
    costs=("max",),
    cost_steps=1,
)
SHIPPED: Final = ReleasePlan(seed=104, scenarios=2, designs=SEEN_DESIGNS)
"""The release on which the weights that ship are scored, and a test scores them again."""
ARMS: Final = {"single": "single", "all": "all"}
"""Arm → who cooperates in training; with `all`, partners drop out as `TrainConfig` has it."""


def _once(name: str, says: str, **changes: Any) -> Row:
    """A row of the first seed's weights of `all` alone."""
    return Row(name=name, says=says, arm="all", first_seed_alone=True, **changes)


def rows_of(protocol: Protocol) -> tuple[Row, ...]:
    """All lines of the tables."""
    return (
        Row(name="single", says="trained and tested alone", arm="single", agents="single"),
        Row(name="all", says="trained and tested with all agents", arm="all"),
        Row(name="all, alone", says="the weights of `all`, tested alone", arm="all", agents="single"),
        Row(name="all, blanked", says="the weights of `all`, all images black", arm="all", control="blank"),
        Row(name="all, strangers", says="`all`, partners of another scenario", arm="all", control="strangers"),
        *(
            _once(f"all, {agents}", f"`all`, tested with `{agents}`", agents=agents)
            for agents in protocol.configurations
        ),
        *(_once(f"all, {off:g} m", f"`all`, poses {off:g} m off", pose_noise=off) for off in protocol.pose_noises),
        *(_once(f"all, {late:g} s", f"`all`, partners {late:g} s late", latency=late) for late in protocol.latencies),
        Row(name="labels, single", says="baseline: labels that the ego sees", kind="baseline", agents="single"),
        Row(name="labels, all", says="baseline: labels that any agent sees", kind="baseline"),
        Row(name="nothing", says="an empty map, no box, no alarm", kind="nothing"),
        Row(name="everything", says="the whole map is one actor", kind="everything"),
    )


COMPARED: Final = (
    ("single", "all"),
    ("single", "all, alone"),
    ("all, alone", "all"),
    ("all, strangers", "all"),
    ("all, blanked", "all"),
)
"""Pairs of rows whose differences, second less first, are given; the first pair has the headline."""
