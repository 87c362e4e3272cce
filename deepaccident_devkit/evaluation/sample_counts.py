"""`SampleCounts`: the counts of samples by token, which can be merged, saved and resumed."""

import copy
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes, reason_text
from deepaccident_devkit.support.text import PathType, counted, path_of
from deepaccident_devkit.support.version import __version__

Counts = Mapping[str, Any]
"""Counts of one sample: name → whole number, float, None, or nested lists of these, as in JSON."""
CountsT = TypeVar("CountsT", bound="SampleCounts")


class SampleCounts(ABC):
    """Counts by sample token, in any order and from any number of processes.

    Attributes:
        repeated: Tokens that were added more than once with equal counts (samplers of distributed
            training repeat samples); each counts once.
    """

    def __init__(self) -> None:
        """Create an instance without samples."""
        self._counts: dict[str, Counts] = {}
        self.repeated: set[str] = set()

    def __repr__(self) -> str:
        """Return the class and the number of samples."""
        samples = counted(len(self), "sample")
        return f"{type(self).__name__}({samples})"

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All choices that affect the counts, as JSON values; merging requires equal settings."""

    def fresh(self: CountsT) -> CountsT:
        """Return a copy with the same settings and without samples."""
        other = copy.copy(self)
        other._counts = {}  # noqa: SLF001 - its own kind
        other.repeated = set()
        return other

    def add(self, token: str, counts: Counts) -> None:
        """Add a sample's counts.

        Raises:
            EvaluationError: If the token is not a string, or the sample was added before with other
                counts.
        """
        if not isinstance(token, str):
            raise EvaluationError(
                f"token: expected the token of the sample as text, found {token!r}"
            )
        if token not in self._counts:
            self._counts[token] = counts
        elif self._counts[token] == counts:
            self.repeated.add(token)
        else:
            raise EvaluationError(
                f"{token}: evaluated twice, with different results; give each sample one prediction"
            )

    def merge(self: CountsT, other: CountsT) -> CountsT:
        """Add all samples of another evaluator, and return this one.

        Raises:
            EvaluationError: If the other evaluator has different settings, or different counts for
                the same sample.
        """
        if type(other) is not type(self) or other.settings != self.settings:
            other_settings = getattr(other, "settings", None)
            raise EvaluationError(
                f"cannot merge: {type(self).__name__} of {self.settings} with "
                f"{type(other).__name__} of {other_settings}; evaluate both with the same settings"
            )
        for token, counts in other._counts.items():  # noqa: SLF001 - its own kind
            self.add(token, counts)
        self.repeated |= other.repeated
        return self

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Counts of each sample by token; these are copies, so callers cannot change the sums."""
        return _Copies(self._counts)

    def clustered(self, clusters: Mapping[str, str]) -> list[list[Counts]]:
        """Group the samples' counts by cluster, for `Evaluator.resampled`.

        The counts are not copied, which would take most of the time.

        Args:
            clusters: Token → name of the sample's cluster. Clusters are returned in the order in
                which their names first appear.
        """
        counts: dict[str, list[Counts]] = {}
        for token, name in clusters.items():
            counts.setdefault(name, []).append(self._counts[token])
        return list(counts.values())

    @property
    def tokens(self) -> set[str]:
        """Tokens of the counted samples."""
        return set(self._counts)

    def __len__(self) -> int:
        """Return the number of counted samples."""
        return len(self._counts)

    def save(self, path: PathType) -> Path:
        """Write all counts to a JSON file, from which `resume` continues, and return its path.

        At any time, the file is either the complete old one or the complete new one.

        Raises:
            EvaluationError: If the file cannot be written.
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
            remedy = "free space there, or choose another file"
            raise EvaluationError(
                f"{target}: the evaluation cannot be saved ({error}); {remedy}"
            ) from error
        return target

    def resume(self: CountsT, path: PathType) -> CountsT:
        """Add the counts that `save` wrote, and return this evaluator.

        Raises:
            EvaluationError: If the file does not exist or cannot be read, or was written with other
                settings, by another evaluator or by another version of the devkit.
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
                f"{source}: is not a saved evaluation ({reason_text(error)}); start again"
            ) from error
        if maker != self.maker:
            raise EvaluationError(
                f"{source}: was saved by {maker}, but this is {self.maker}; start again"
            )
        if settings != self.settings:
            raise EvaluationError(
                f"{source}: was saved with other settings ({settings}); start again, or use "
                "the same settings"
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
        """Class and devkit version that computed the counts, as versions may count differently."""
        class_name = type(self).__name__
        return f"{class_name} of devkit {__version__}"


class _Copies(Mapping[str, Counts]):
    """Mapping from tokens to counts, which are copied on access."""

    def __init__(self, counts: Mapping[str, Counts]) -> None:
        self._counts = counts

    def __getitem__(self, token: str) -> Counts:
        copied: Counts = _copy_json(self._counts[token])
        return copied

    def __contains__(self, token: object) -> bool:
        return token in self._counts

    def __iter__(self) -> Iterator[str]:
        return iter(self._counts)

    def __len__(self) -> int:
        return len(self._counts)


def _copy_json(value: Any) -> Any:
    """Copy a JSON value, much faster than `copy.deepcopy` does."""
    if isinstance(value, Mapping):
        return {name: _copy_json(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_copy_json(item) for item in value]
    return value
