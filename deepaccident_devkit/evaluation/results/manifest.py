"""`Manifest`: what the results.json of motion results says: their form, and which samples are in which shard."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, Final

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results.faults import ContentError, at, shown
from deepaccident_devkit.evaluation.results.form import MotionForm
from deepaccident_devkit.evaluation.results.header import check_fields, check_token
from deepaccident_devkit.files import irregular_text

SHARD_FIELDS: Final = ("file", "tokens", "bytes", "checksum")


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """An archive of some samples.

    Attributes:
        file: its path in the folder of the results, with `/`.
        tokens: of its samples, in order.
        bytes: its size.
        checksum: BLAKE2b of its bytes, 16 bytes as hexadecimal digits (`files.file_checksum`).
    """

    file: str
    tokens: tuple[str, ...]
    bytes: int
    checksum: str

    def as_dict(self) -> dict[str, Any]:
        """The shard as JSON holds it."""
        return {"file": self.file, "tokens": list(self.tokens), "bytes": self.bytes, "checksum": self.checksum}


@dataclass(frozen=True, slots=True, eq=False)
class Manifest:
    """The form and the shards of motion results.

    Attributes:
        form: how predictions are stored.
        shards: the archives.
        shard_of: token → number of its shard, in the order of the shards.
    """

    form: MotionForm
    shards: tuple[Shard, ...]
    shard_of: Mapping[str, int]


def read_manifest(document: Mapping[str, Any], root: Path) -> Manifest:
    """The manifest of the results in a folder, whose shards are there and as long as it says.

    Raises:
        ContentError: names the field, or the shard.
    """
    with at("form"):
        form = _form(document["form"])
    told = document["shards"]
    if not isinstance(told, list) or not told:
        raise ContentError(f"shards: expected a list of at least one, found {shown(told)}")
    shards: list[Shard] = []
    shard_of: dict[str, int] = {}
    for number, each in enumerate(told):
        with at(f"shards: entry {number}"):
            shard = _shard(each)
            _check_file(shard, root, {other.file for other in shards})
        for token in shard.tokens:
            if token in shard_of:
                others = "twice" if shard_of[token] == number else f"also in {shards[shard_of[token]].file}"
                raise ContentError(f"{shard.file}: {token}: stands there {others}; store a sample once")
            shard_of[token] = number
        shards.append(shard)
    return Manifest(form, tuple(shards), MappingProxyType(shard_of))


def _form(told: object) -> MotionForm:
    if not isinstance(told, dict):
        raise ContentError(f"expected an object, found {shown(told)}")
    check_fields(told, MotionForm.FIELDS)
    try:
        return MotionForm.from_dict(told)
    except ResultsError as error:
        raise ContentError(str(error)) from error


def _shard(told: object) -> Shard:
    if not isinstance(told, dict):
        raise ContentError(f"expected an object, found {shown(told)}")
    check_fields(told, SHARD_FIELDS)
    file, tokens, size, checksum = (told[name] for name in SHARD_FIELDS)
    if not isinstance(file, str) or not file.isprintable() or "\\" in file or not _is_inside(PurePosixPath(file)):
        raise ContentError(f"file: expected a path inside the folder of the results, found {shown(file)}")
    if not isinstance(tokens, list) or not tokens:
        raise ContentError(f"tokens: expected a list of at least one token, found {shown(tokens)}")
    with at("tokens"):
        names = tuple(check_token(token) for token in tokens)
    if type(size) is not int or size < 0:
        raise ContentError(f"bytes: expected the file's size, a whole number, found {shown(size)}")
    if not isinstance(checksum, str):
        raise ContentError(f"checksum: expected a text, found {shown(checksum)}")
    return Shard(file=file, tokens=names, bytes=size, checksum=checksum)


def _is_inside(path: PurePosixPath) -> bool:
    return not path.is_absolute() and path.parts != () and ".." not in path.parts


def _check_file(shard: Shard, root: Path, others: AbstractSet[str]) -> None:
    """Whether a shard's file is there, as long as it should be, in the folder, and not another shard's too."""
    path = root / shard.file
    if shard.file in others:
        raise ContentError(f"file: {shard.file} is another entry's too; list each file once")
    try:
        status = path.stat()
        inside = path.resolve().is_relative_to(root.resolve())
    except OSError as error:
        raise ContentError(f"file: {shard.file} cannot be opened ({error.strerror}); copy it to its place") from error
    if not inside:
        raise ContentError(f"file: {shard.file} is a link that leads out of the folder; put the file itself there")
    irregular = irregular_text(status.st_mode)
    if irregular:
        raise ContentError(f"file: {shard.file} is {irregular}")
    if status.st_size != shard.bytes:
        raise ContentError(f"bytes: {shard.file} should have {shard.bytes}, found {status.st_size}; copy it again")
