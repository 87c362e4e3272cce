"""Serve a release on S3 from this machine, once as single files and once as one zip.

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
from support.linux_processes import wait_for
from support.zipped_releases import release_files, zip_release

_REQUIRED_PACKAGES = ("s3fs", "moto")

if missing := [name for name in _REQUIRED_PACKAGES if importlib.util.find_spec(name) is None]:
    if os.environ.get("DEEPACCIDENT_REQUIRE_CLOUD"):
        raise pytest.UsageError(
            f"DEEPACCIDENT_REQUIRE_CLOUD is set, but {', '.join(missing)} is not installed"
        )
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session")
def bucket(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The URL of a bucket with the release below `data/DeepAccident` and in `zips/all.zip`."""
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
            wait_for(lambda: _accepts_connections(port))
            files = s3fs.S3FileSystem()
            files.mkdir("bucket")
            paths = release_files(release_root)
            names = [path.relative_to(release_root).as_posix() for path in paths]
            files.put(
                [str(path) for path in paths],
                [f"bucket/data/DeepAccident/{name}" for name in names],
            )
            archive = zip_release(release_root, tmp_path_factory.mktemp("bucket") / "all.zip")
            files.put(str(archive), "bucket/zips/all.zip")
            yield "s3://bucket"
        finally:
            server.terminate()


def _accepts_connections(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0
