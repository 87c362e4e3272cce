"""Checkpoints of PyTorch, read without it; those that PyTorch writes are in
`tests/torch_extra/model`.
"""

import pytest

from deepaccident_devkit.release.checkpoints import FAULTS, read_checkpoint

OLD = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."


@pytest.mark.parametrize(
    "content",
    [b"", b"PK", b"a" * 99, OLD, OLD + b"N.", OLD + b"S'\\q'\n.", OLD + b"cposix\nsystem\n."],
)
def test_what_is_no_checkpoint_raises_one_of_the_faults(content: bytes) -> None:
    """Here warnings are errors; Python warns of the escape in a text of Python 2."""
    with pytest.raises(FAULTS):
        read_checkpoint(content)
