"""Two sides of a video: an accident and its normal twin, or a recording and models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.collisions.recorded import Accident, accident_of
from deepaccident_devkit.collisions.twin_matching import (
    matched_rows,
    shift_of,
    shifted_recording,
    twin_recordings,
)
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnPlaces
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.render.accident import draw_until, finish_time_axis
from deepaccident_devkit.render.captions import INSIDE, draw_legend, moment_words, set_title
from deepaccident_devkit.render.outcomes.described import SampleDrawing, sample_drawing
from deepaccident_devkit.render.outcomes.drawings import DRAWING_LAYERS, draw_drawing_from_above
from deepaccident_devkit.render.styles import COLLIDER_COLOR, LINK_COLOR, PREDICTED_COLOR
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, UNTRACKED_ID, short_name
from deepaccident_devkit.v2x.tracks import pair_approach, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Longest time to collision in the strip.
_MAX_TIME_S = 6.0
# Corners of the part of the road that all pictures of a model show, metres in the ego frame.
_SHOWN = Drawing(
    places=(DrawnPlaces(xy=np.array([[-12.0, -22.0], [32.0, 22.0]]), time=0.0, role="past"),)
)
_MODEL_COLORS = (PREDICTED_COLOR, LINK_COLOR)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Side:
    """A recording of T frames, how close two of its actors come, and what a model predicts.

    Attributes:
        scenario: Token of the scenario.
        name: What the side is called, such as `normal twin`.
        color: Colour of its words and its curve.
        has_collision: Whether the scenario ends in a collision.
        gap: Gap between the two from above in metres, shape (T,); NaN where unknown.
        ttc: Time to collision in seconds, shape (T,); infinite if they would never touch.
        shift: Frame number in the recording minus the frame number in the video.
        agent: Agent whose predictions are shown; empty on a side without a model.
        results: Results of the model.
        task: Task that draws the results.
    """

    scenario: str
    name: str
    color: str
    has_collision: bool
    gap: FloatArray
    ttc: FloatArray
    shift: int = 0
    agent: str = ""
    results: Results | None = None
    task: str = ""

    def frame(self, number: int) -> int:
        """Return the recorded frame that is nearest to a frame of the video."""
        return int(np.clip(number + self.shift, 1, len(self.gap)))

    def verdict(self, number: int) -> str:
        """Return what happens to the two, as known at a frame of the video."""
        frame = self.frame(number)
        words = [f"{self.name}: no collision"]
        if self.has_collision:
            seconds_left = (len(self.gap) - frame) * FRAME_PERIOD
            time = f"in {seconds_left:.1f} s" if seconds_left else "now"
            words = [f"{self.name}: collision {time}"]
        if np.isfinite(self.gap[frame - 1]):
            words.append(f"{self.gap[frame - 1]:.1f} m apart")
        if not self.has_collision and np.isfinite(self.gap).any():
            words.append(f"never closer than {np.nanmin(self.gap):.1f} m")
        if frame != number + self.shift:
            words.append("recording has not begun" if frame == 1 else "recording has ended")
        return ", ".join(words)

    def described(self, dataset: Dataset, number: int) -> SampleDrawing | None:
        """Describe the model's last prediction up to a frame; None on a side without a model."""
        if self.results is None:
            return None
        for frame in range(self.frame(number), 0, -1):
            sample = sample_token(self.scenario, self.agent, frame)
            if sample in self.results:
                prediction = self.results.prediction(sample)
                return sample_drawing(dataset, sample, prediction, task=self.task)
        sample = sample_token(self.scenario, self.agent, number)
        return SampleDrawing(sample=sample, drawing=Drawing(), words=": no prediction yet")


def draw_described(described: SampleDrawing, dataset: Dataset, _frame: Any, fig: Figure) -> None:
    """Draw a prediction from above on an empty figure."""
    layers = frozenset(DRAWING_LAYERS) - {"ids"}
    ax = fig.add_subplot()
    handles = draw_drawing_from_above(
        dataset, described.sample, described.drawing, layers, ax, shown=_SHOWN
    )
    set_title(ax, moment_words(dataset, described.sample), fontsize="medium")
    draw_legend(ax, handles, columns=1, **INSIDE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beside:
    """Two sides on one clock, which counts down to the end of a recording.

    Attributes:
        sides: The left and the right side.
        curves: The recording, and its twin on the other side.
        pair: Names of the two colliding actors.
    """

    sides: tuple[Side, Side]
    curves: tuple[Side, ...]
    pair: str

    @property
    def num_frames(self) -> int:
        """The number of frames of the video, from the first one of the recording."""
        return max(len(side.gap) - side.shift for side in self.curves)

    def write_verdicts(self, fig: Figure, verdicts: Sequence[str]) -> None:
        """Write the verdict of each side above it."""
        fig.set_layout_engine("none")  # there is no room for margins
        axes = fig.subplots(1, 2, gridspec_kw={"left": 0, "right": 1, "wspace": 0})
        for side, words, ax in zip(self.sides, verdicts, axes, strict=True):
            ax.set_axis_off()
            set_title(ax, words, color=side.color, fontsize="large", y=0.0)

    def draw_times(self, ax: Axes, number: int) -> None:
        """Draw the clock and the times to collision, strong up to a frame and pale after it."""
        recording = self.curves[0]
        end = len(recording.gap)
        now = (number - end) * FRAME_PERIOD
        for side in self.curves:
            seconds = (np.arange(1, len(side.ttc) + 1) - side.shift - end) * FRAME_PERIOD
            ttc = np.where(side.ttc <= _MAX_TIME_S, side.ttc, np.nan)
            draw_until(ax, seconds, ttc, now, side.name, color=side.color)
        last = (self.num_frames - end) * FRAME_PERIOD
        ax.set(xlim=((1 - end) * FRAME_PERIOD, last + 0.05), ylim=(0, _MAX_TIME_S))
        event = "impact" if recording.has_collision else "end"
        finish_time_axis(ax, now, event)
        order = "after" if now > 0 else "before"
        ax.set_title(f"time to collision of {self.pair} (s)", loc="left", fontsize="medium")
        ax.set_title(f"{abs(now):.1f} s {order} the {event}", loc="right", fontweight="bold")
        ax.legend(loc="upper right", ncols=2)


def beside_twin(dataset: Dataset, scenario: RowArgument) -> Beside:
    """Put an accident beside its normal twin; the scenario may be either of the two.

    Raises the errors of `collisions.twin_matching.twin_recordings`.
    """
    accident, recording, twin = twin_recordings(dataset, scenario)
    shift = shift_of(recording, twin)
    shifted_twin = shifted_recording(twin, shift)
    matches = matched_rows(recording, shifted_twin)
    twin_ids = {
        recording.actor_id[row]: twin.actor_id[other] for row, (other, _) in matches.items()
    }
    first, second = (int(twin_ids.get(actor, UNTRACKED_ID)) for actor in accident.actor_ids)
    left = _recording_side(
        dataset, accident.scenario, accident.actor_ids, "accident", COLLIDER_COLOR
    )
    right = _recording_side(
        dataset, twin.scenario, (first, second), "normal twin", LINK_COLOR, shift
    )
    sides = (left, right)
    return Beside(sides=sides, curves=sides, pair=_pair_words(accident))


def beside_models(
    dataset: Dataset,
    scenario: RowArgument,
    results: Mapping[str, Results],
    *,
    task: str | None = None,
    agents: Sequence[str] = AGENTS,
) -> Beside:
    """Put a recording beside the predictions of one model, or those of two models side by side.

    Args:
        dataset: The release.
        scenario: Token or record.
        results: Results of one or two models by name.
        task: Task that draws the predictions; None for the kind of the results.
        agents: Agents whose predictions may be shown; the first one with predictions is.

    Raises:
        TokenError: No such scenario.
        ChoiceError: There are more than two models, or the predictions are for another task.
        NotAvailableError: A model has no prediction for the scenario and the agents, the release
            lacks the truth that the task needs, or the scenario has no meta file.
    """
    if not 1 <= len(results) <= 2:
        raise ChoiceError(f"beside: expected one or two models, found {len(results)}")
    accident = accident_of(dataset, scenario)
    pair = accident.actor_ids if accident is not None else (UNTRACKED_ID, UNTRACKED_ID)
    token = dataset.get("scenario", scenario)["token"]
    recording = _recording_side(dataset, token, pair, "recording", COLLIDER_COLOR)
    sides = [recording]
    for (name, predictions), color in zip(results.items(), _MODEL_COLORS, strict=False):
        agent = _predicted_agent(recording, predictions, agents)
        model_task = task or predictions.task
        side = replace(recording, name=name or "prediction", color=color, results=predictions)
        sides.append(replace(side, agent=agent, task=model_task))
    return Beside(sides=(sides[-2], sides[-1]), curves=(recording,), pair=_pair_words(accident))


def _predicted_agent(recording: Side, results: Results, agents: Sequence[str]) -> str:
    """Return the first of some agents with predictions."""
    for agent in agents:
        for number in range(1, len(recording.gap) + 1):
            if sample_token(recording.scenario, agent, number) in results:
                return agent
    raise NotAvailableError(
        f"{results.path}: has no prediction for {recording.scenario} and {', '.join(agents)}; "
        "choose a scenario and agents that it has"
    )


def _recording_side(
    dataset: Dataset,
    scenario: str,
    pair: tuple[int, int],
    name: str,
    color: str,
    shift: int = 0,
) -> Side:
    record = dataset.get("scenario", scenario)
    gap, ttc = pair_approach(scenario_tracks(dataset, record), pair, record["num_frames"])
    return Side(
        scenario=scenario,
        name=name,
        color=color,
        has_collision=record["collision"] is not None,
        gap=gap,
        ttc=ttc,
        shift=shift,
    )


def _pair_words(accident: Accident | None) -> str:
    """Name the colliding actors: agents by their names, others by their classes."""
    if accident is None:
        return "the predicted pair"
    names = []
    for agent, category in zip(accident.agents, accident.categories, strict=True):
        names.append(category if agent is None else short_name(agent))
    return " and ".join(names)
