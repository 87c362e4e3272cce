"""An accident beside its normal twin: how close the same two actors come in both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.boxes import recorders_of
from deepaccident_devkit.render.figures import with_light_grid
from deepaccident_devkit.render.styles import COLLIDER_COLOR, LINK_COLOR, MUTED_COLOR
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.tables.records import ScenarioRecord
from deepaccident_devkit.taxonomy import FRAME_PERIOD, short_name
from deepaccident_devkit.v2x.collisions import colliding_pair
from deepaccident_devkit.v2x.tracks import pair_approach, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Longest time to collision in the strip.
_MAX_TIME_S = 6.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Approach:
    """How close two actors come in a recording of T frames.

    Attributes:
        scenario: Token of the scenario.
        name: What the recording is called, `accident` or `normal twin`.
        color: Colour of its words and its curve.
        has_collision: Whether the scenario ends in a collision.
        gap: Gap between the two from above in metres, shape (T,); NaN where unknown.
        ttc: Time to collision in seconds, shape (T,); infinite if they would never touch.
    """

    scenario: str
    name: str
    color: str
    has_collision: bool
    gap: FloatArray
    ttc: FloatArray

    def verdict(self, frame: int) -> str:
        """Return what happens to the two, as known at a frame, from 1; the last one if later."""
        last_frame = len(self.gap)
        row = min(frame, last_frame) - 1
        words = [f"{self.name}: collision" if self.has_collision else f"{self.name}: no collision"]
        seconds_left = (last_frame - 1 - row) * FRAME_PERIOD
        if self.has_collision:
            words[0] += f" in {seconds_left:.1f} s" if seconds_left else " now"
        if np.isfinite(self.gap[row]):
            words.append(f"{self.gap[row]:.1f} m apart")
        if not self.has_collision and np.isfinite(self.gap).any():
            words.append(f"never closer than {np.nanmin(self.gap):.1f} m")
        if frame > last_frame:
            words.append("recording has ended")
        return ", ".join(words)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BesideTwin:
    """An accident and its normal twin on one clock, which starts with the recordings.

    Attributes:
        sides: The accident and the twin.
        pair: Names of the two colliding actors.
    """

    sides: tuple[Approach, Approach]
    pair: str

    @classmethod
    def of(cls, dataset: Dataset, scenario: RowArgument) -> BesideTwin:
        """Find the accident and the twin of a scenario, which may be either of the two.

        Raises:
            TokenError: No such scenario.
            NotAvailableError: The release has no twin of it, neither of them has a collision, or
                the accident has no meta file.
        """
        record = dataset.scenario[dataset.getind("scenario", scenario)]
        twin = twin_of(dataset, record)
        if twin is None:
            raise NotAvailableError(
                f"{record['token']}: this release has no twin of it, with the same name and "
                "subtype; choose another scenario, or leave `beside` out"
            )
        accident, normal = record, twin
        if accident["collision"] is None:
            accident, normal = twin, record
        pair = colliding_pair(accident)
        if pair is None:
            raise NotAvailableError(
                f"{record['token']}: neither it nor its twin has a collision; choose an accident"
            )
        agents = recorders_of(dataset, accident["token"])
        normal_agents = recorders_of(dataset, normal["token"])
        own_actors = {agent: actor for actor, agent in normal_agents.items()}
        normal_pair = []
        names = []
        for actor in pair:
            agent = agents.get(actor)
            normal_pair.append(actor if agent is None else own_actors.get(agent, actor))
            names.append(f"actor {actor}" if agent is None else short_name(agent))
        accident_side = _approach(dataset, accident, pair, "accident", COLLIDER_COLOR)
        normal_side = _approach(
            dataset, normal, (normal_pair[0], normal_pair[1]), "normal twin", LINK_COLOR
        )
        return cls(sides=(accident_side, normal_side), pair=" and ".join(names))

    @property
    def num_frames(self) -> int:
        """The number of frames of the longer recording."""
        return max(len(side.gap) for side in self.sides)

    def write_verdicts(self, fig: Figure, frame: int) -> None:
        """Write the verdict of each side, as of a frame, above it."""
        for side, x in zip(self.sides, (0.25, 0.75), strict=True):
            fig.text(x, 0.45, side.verdict(frame), color=side.color, ha="center", va="center")

    def draw_times(self, ax: Axes, frame: int) -> None:
        """Draw the clock and the times to collision, strong up to the frame and pale after it."""
        now = (frame - 1) * FRAME_PERIOD
        for side in self.sides:
            seconds = np.arange(len(side.ttc)) * FRAME_PERIOD
            ttc = np.where(side.ttc <= _MAX_TIME_S, side.ttc, np.nan)
            ax.plot(seconds, ttc, color=side.color, linewidth=1.2, alpha=0.3)
            past = slice(frame)
            ax.plot(seconds[past], ttc[past], ".-", color=side.color, ms=3, label=side.name)
            ax.axvline(seconds[-1], color=side.color, linewidth=1.0, linestyle=":")
        ax.axvline(now, color="black", linewidth=1.2)
        ax.set(xlim=(0, (self.num_frames - 1) * FRAME_PERIOD + 0.05), ylim=(0, _MAX_TIME_S))
        ax.set_title(f"time to collision of {self.pair} (s)", loc="left", fontsize="medium")
        ax.set_title(f"{now:.1f} s", loc="right", fontweight="bold")
        ax.set_xlabel("time since the recordings began (s); dotted: their ends", color=MUTED_COLOR)
        ax.legend(loc="upper left", ncols=2)
        with_light_grid(ax, "both")


def _approach(
    dataset: Dataset, scenario: ScenarioRecord, pair: tuple[int, int], name: str, color: str
) -> Approach:
    gap, ttc = pair_approach(scenario_tracks(dataset, scenario), pair, scenario["num_frames"])
    return Approach(
        scenario=scenario["token"],
        name=name,
        color=color,
        has_collision=scenario["collision"] is not None,
        gap=gap,
        ttc=ttc,
    )
