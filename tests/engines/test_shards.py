"""Every bulk command in eight shards, one after another as a loop of the shell has them."""

from pathlib import Path

import pytest
from engines.products import COMMANDS, Local, command, contents, done, words

pytestmark = pytest.mark.slow

COUNT = 8
PARTS = ("--shard $shard/8", "--merge")


def test_all_is_the_same(local: Local, tmp_path: Path) -> None:
    for name in COMMANDS:
        line = " ".join(command(words(name, {**local.places, "out": tmp_path}, parts=True)))
        printed = done(["bash", "-ec", f"for shard in $(seq {COUNT}); do {line} {PARTS[0]} >/dev/null; done"])
        printed = done(["bash", "-ec", f"{line} {PARTS[1]}"])
        if name == "validate":
            assert printed == local.printed
    made = {path: content for path, content in contents(tmp_path).items() if not path.startswith("validate")}
    assert made == local.files
