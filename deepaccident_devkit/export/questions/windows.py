"""Which moments a question is about: the window that was observed, and its present."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

from deepaccident_devkit.arrays import checked_number, checked_whole
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.keyframes import KEY_STEP
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_FRAMES_A_SECOND = round(1 / FRAME_PERIOD)
_SAME = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The moments of one question, as numbers of recorded frames.

    Attributes:
        frames: ascending; the last one is the present.
    """

    frames: tuple[int, ...]

    @property
    def present(self) -> int:
        """The frame from which the question looks ahead."""
        return self.frames[-1]

    @property
    def times(self) -> list[float]:
        """Seconds of each moment relative to the present, from the earliest to 0.0."""
        return [round((frame - self.present) * FRAME_PERIOD, 1) + 0.0 for frame in self.frames]


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowRules:
    """Which windows a recording has.

    Presents are counted back from the last frame, as the samples of evaluations are; the last frame itself, which in an
    accident is the impact, is none. The rule is the same for recordings with and without an accident.

    Attributes:
        observe: seconds before the present that are shown; 0 for the present alone. A whole number of steps of `rate`.
        rate: moments a second of a window: 1, 2, 5 or 10.
        ahead: whole seconds after the present that are asked about.
        stride: seconds from one window of a recording to the next, a multiple of 0.5.
        partial_past: whether there are also windows that begin before the recording, of whose moments only the recorded
            ones count. Their number then tells how long the recording has run.
        most: windows of a recording at most, drawn by the seed; None for all.

    Raises:
        ConfigError: a value that this cannot be.
    """

    observe: float = 5.0
    rate: int = 2
    ahead: int = 3
    stride: float = 1.0
    partial_past: bool = False
    most: int | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        rate = checked_whole("rate", self.rate, "moments a second", ConfigError)
        if rate < 1 or _FRAMES_A_SECOND % rate:
            raise ConfigError(f"rate: expected 1, 2, 5 or 10 moments a second, found {self.rate!r}")
        _check_steps("observe", self.observe, 1 / rate, least=0)
        _check_steps("stride", self.stride, KEY_STEP * FRAME_PERIOD, least=1)
        for name in ("ahead", "most"):
            value = getattr(self, name)
            if value is None and name == "most":
                continue
            if checked_whole(name, value, "a whole number from 1", ConfigError) < 1:
                raise ConfigError(f"{name}: expected a whole number from 1, found {value!r}")

    def windows(self, last: int, drawn: str, seed: str) -> list[Window]:
        """The windows of a recording of frames 1 to `last`, in the order of time.

        Args:
            last: number of the last frame.
            drawn: what names the recording; with `seed` it decides which windows are drawn where `most` are wanted.
            seed: any text.
        """
        step, stride = _FRAMES_A_SECOND // self.rate, round(self.stride / FRAME_PERIOD)
        past = round(self.observe / FRAME_PERIOD)
        presents = [number for number in range(last - stride, 0, -stride) if self.partial_past or number > past]
        if self.most is not None:
            presents = sorted(presents, key=lambda number: digest(seed, "window", drawn, str(number)))[: self.most]
        return [
            Window(frames=tuple(frame for frame in range(present - past, present + 1, step) if frame > 0))
            for present in sorted(presents)
        ]


def digest(seed: str, *words: str) -> str:
    """Sixteen hexadecimal digits for some words, which tell nothing about these without the seed."""
    key = hashlib.blake2b(seed.encode(), digest_size=32).digest()
    return hashlib.blake2b("\0".join(words).encode(), key=key, digest_size=8).hexdigest()


def _check_steps(name: str, value: float, step: float, *, least: int) -> None:
    seconds = checked_number(name, value, "a number of seconds", ConfigError)
    steps = seconds / step
    if not math.isfinite(steps) or steps < least - _SAME or abs(steps - round(steps)) > _SAME:
        raise ConfigError(f"{name}: expected seconds from {least * step:g} in steps of {step:g}, found {value!r}")
