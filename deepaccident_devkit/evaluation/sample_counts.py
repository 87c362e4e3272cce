"""`SampleCounts`: what each sample adds to the numbers, by token: add, merge, save and resume."""

from __future__ import annotations

import copy
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.support.version import __version__

Counts = Mapping[str, Any]
"""What one sample adds: names → whole numbers, floats, None, or nested lists of them, as in
JSON."""
CountsT = TypeVar("CountsT", bound="SampleCounts")


class SampleCounts(ABC):
    """Counts by sample token, in any order and from any number of processes.

    Attributes:
        repeated: Tokens that came more than once with equal counts (samplers of distributed
            training do that); each counts once.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self._counts: dict[str, Counts] = {}
        self.repeated: set[str] = set()

    def __repr__(self) -> str:
        """Return the class and the number of samples."""
        return (
            f"{type(self).__name__}({len(self._counts):,} sample{'s' * (len(self._counts) != 1)})"
        )

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All choices that affect the counts, as in JSON; only equal settings can be merged."""

    def fresh(self: CountsT) -> CountsT:
        """Return a copy with the same settings and without samples."""
        other = copy.copy(self)
        other._counts, other.repeated = {}, set()  # noqa: SLF001 - its own kind
        return other

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts.

        Raises:
            EvaluationError: the token is not a text, or the sample came before with other counts.
        """
        if not isinstance(token, str):
            raise EvaluationError(f"token: expected the sample's token, a text, found {token!r}")
        if token not in self._counts:
            self._counts[token] = counts
        elif self._counts[token] == counts:
            self.repeated.add(token)
        else:
            raise EvaluationError(
                f"{token}: evaluated twice, with different results; give each sample one prediction"
            )

    def merge(self: CountsT, other: CountsT) -> CountsT:
        """Take all samples of another evaluator; returns this one.

        Raises:
            EvaluationError: it has other settings, or other counts of the same sample.
        """
        if type(other) is not type(self) or other.settings != self.settings:
            raise EvaluationError(
                f"cannot merge: {type(self).__name__} of {self.settings} with "
                f"{type(other).__name__} of "
                f"{getattr(other, 'settings', None)}; evaluate both with the same settings"
            )
        for token, counts in other._counts.items():  # noqa: SLF001 - its own kind
            self.add(token, counts)
        self.repeated |= other.repeated
        return self

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Counts of each sample by token, copied, so that callers cannot change the sums."""
        return _Copies(self._counts)

    def clustered(self, clusters: Mapping[str, str]) -> list[list[Counts]]:
        """Return the counts of some samples by cluster, for `resampled`.

        They are not copies, which would take most of the time.

        Args:
            clusters: Token → name of its cluster; clusters come in the order of their names' first
                appearance.
        """
        counts: dict[str, list[Counts]] = {}
        for token, name in clusters.items():
            counts.setdefault(name, []).append(self._counts[token])
        return list(counts.values())

    @property
    def tokens(self) -> set[str]:
        """Tokens of the samples counted."""
        return set(self._counts)

    def __len__(self) -> int:
        """Return the number of samples counted."""
        return len(self._counts)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all counts to a JSON file, from which an interrupted run goes on; returns its path.

        At any moment the file is either the complete old or the complete new one.

        Raises:
            EvaluationError: the file cannot be written.
        """
        target = path_of(path)
        state = {
            "made_by": self.maker,
            "settings": self.settings,
            "repeated": sorted(self.repeated),
            "counts": {token: self._counts[token] for token in sorted(self._counts)},
        }
        try:
            write_bytes(target, json.dumps(state).encode())
        except OSError as error:
            remedy = "make room there, or choose another file"
            raise EvaluationError(
                f"{target}: the evaluation cannot be saved ({error}); {remedy}"
            ) from error
        return target

    def resume(self: CountsT, path: str | os.PathLike[str]) -> CountsT:
        """Take the counts that `save` wrote; returns this evaluator.

        Raises:
            EvaluationError: there is no such file, it cannot be read, or it is of other settings,
                another evaluator or another version of the devkit.
        """
        source = path_of(path)
        try:
            state = parsed_json(read_bytes(source, "results"), constants=True)
            maker = state["made_by"]
            settings = state["settings"]
            repeated = set(state["repeated"])
            counts = {token: dict(sample) for token, sample in state["counts"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise EvaluationError(
                f"{source}: no saved evaluation ({fault_text(error)}); begin again"
            ) from error
        if maker != self.maker:
            raise EvaluationError(
                f"{source}: was saved by {maker}, this is {self.maker}; begin again"
            )
        if settings != self.settings:
            raise EvaluationError(
                f"{source}: was saved with other settings ({settings}); begin again, or use those"
            )
        try:
            for token, sample_counts in counts.items():
                self.add(token, sample_counts)
        except EvaluationError as error:
            raise EvaluationError(f"{source}: {error}") from error
        self.repeated |= repeated
        return self

    @property
    def maker(self) -> str:
        """Class and version that made the counts: another version may count differently."""
        return f"{type(self).__name__} of devkit {__version__}"


class _Copies(Mapping[str, Counts]):
    """Counts by token, returned as copies."""

    def __init__(self, counts: Mapping[str, Counts]) -> None:
        self._counts = counts

    def __getitem__(self, token: str) -> Counts:
        copied: Counts = _copied(self._counts[token])
        return copied

    def __contains__(self, token: object) -> bool:
        return token in self._counts

    def __iter__(self) -> Iterator[str]:
        return iter(self._counts)

    def __len__(self) -> int:
        return len(self._counts)


def _copied(value: Any) -> Any:
    """Return a copy of JSON values; much faster than `copy.deepcopy`."""
    if isinstance(value, Mapping):
        return {name: _copied(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_copied(item) for item in value]
    return value
