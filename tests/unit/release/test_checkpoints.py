"""Read checkpoints of PyTorch without it; `tests/torch_extra/model` has tests with checkpoints that
PyTorch writes.
"""

import pytest

from deepaccident_devkit.release.checkpoints import FAULTS, read_checkpoint

OLD = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."


@pytest.mark.parametrize(
    "content",
    [b"", b"PK", b"a" * 99, OLD, OLD + b"N.", OLD + b"S'\\q'\n.", OLD + b"cposix\nsystem\n."],
)
def test_what_is_no_checkpoint_raises_one_of_the_faults(content: bytes) -> None:
    """The tests turn warnings into errors, and Python warns of the escape in a Python 2 text."""
    with pytest.raises(FAULTS):
        read_checkpoint(content)
