"""An S3 server of this machine alone, with a release in a bucket, loose and as one zip.

Not collected where s3fs and moto are not installed, unless DEEPACCIDENT_REQUIRE_CLOUD is set.
"""

import importlib.util
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from packing import files_of, packed
from processes import wait_for

_NEEDED = ("s3fs", "moto")

if missing := [name for name in _NEEDED if importlib.util.find_spec(name) is None]:
    if os.environ.get("DEEPACCIDENT_REQUIRE_CLOUD"):
        raise pytest.UsageError(
            f"DEEPACCIDENT_REQUIRE_CLOUD is set, but {', '.join(missing)} is not installed"
        )
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session")
def bucket(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """`s3://bucket`, with the release loose below `data/DeepAccident` and in `zips/all.zip`."""
    import s3fs

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    environment = {
        "AWS_ACCESS_KEY_ID": "AKIAOFTHETESTS",
        "AWS_SECRET_ACCESS_KEY": "a-secret-of-the-tests",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
    }
    output = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with pytest.MonkeyPatch.context() as patch, subprocess.Popen(command, **output) as server:
        for name, value in environment.items():
            patch.setenv(name, value)
        try:
            wait_for(lambda: _answers(port))
            files = s3fs.S3FileSystem()
            files.mkdir("bucket")
            below = {
                path: path.relative_to(release_root).as_posix() for path in files_of(release_root)
            }
            files.put(
                [str(path) for path in below],
                [f"bucket/data/DeepAccident/{name}" for name in below.values()],
            )
            archive = packed(release_root, tmp_path_factory.mktemp("bucket") / "all.zip")
            files.put(str(archive), "bucket/zips/all.zip")
            yield "s3://bucket"
        finally:
            server.terminate()


def _answers(port: int) -> bool:
    with socket.socket() as asked:
        return asked.connect_ex(("127.0.0.1", port)) == 0
