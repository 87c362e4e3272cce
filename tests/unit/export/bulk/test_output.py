"""What a format writes: files that are complete or absent, counts, links and what stands for them."""

import errno
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.export.bulk import Link, Output
from deepaccident_devkit.support.files import temporary_path


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.jpg"
    path.write_bytes(b"a picture")
    return path


def output_of(tmp_path: Path, link: Link = "hard", note: Callable[[str], object] = lambda _: None) -> Output:
    return Output(tmp_path / "out", tmp_path / "parts", link, note=note)


def refusing(code: int) -> Callable[..., None]:
    def make(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    return make


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def test_files_are_noted_counted_and_whole(tmp_path: Path, source: Path) -> None:
    noted: list[str] = []
    output = output_of(tmp_path, note=noted.append)
    output.write("a/b.txt", b"12")
    with output.file("c.txt") as path:
        assert noted[-1] == "c.txt"
        path.write_bytes(b"345")
    output.link(source, "d.jpg")
    with output.whole_folder("e/f") as folder:
        folder.write("g.txt", b"6")
        folder.link(source, "h/i.jpg")
        assert not (tmp_path / "out" / "e" / "f").exists()
    assert noted == ["a/b.txt", "c.txt", "d.jpg", "e/f"]
    assert names(tmp_path / "out") == ["a/b.txt", "c.txt", "d.jpg", "e/f/g.txt", "e/f/h/i.jpg"]
    assert (output.tally.files, output.tally.bytes, output.tally.linked) == (3, 6, Counter(hard=2))


def write_half(output: Output) -> None:
    with output.file("a.txt") as path:
        path.write_bytes(b"12")
        raise ValueError("no more")


def write_half_a_folder(output: Output) -> None:
    with output.whole_folder("b") as folder:
        folder.write("c.txt", b"12")
        raise ValueError("no more")


@pytest.mark.parametrize("write", [write_half, write_half_a_folder])
def test_what_fails_is_absent(tmp_path: Path, write: Callable[[Output], None]) -> None:
    with pytest.raises(ValueError, match="no more"):
        write(output_of(tmp_path))
    assert not list((tmp_path / "out").iterdir())


def test_a_whole_folder_takes_the_place_of_an_older_one(tmp_path: Path) -> None:
    output = output_of(tmp_path)
    with output.whole_folder("a") as folder:
        folder.write("old.txt", b"")
    with output.whole_folder("a") as folder:
        folder.write("new.txt", b"")
    assert names(tmp_path / "out") == ["a/new.txt"]


def test_leftovers_beside_a_whole_folder_are_removed(tmp_path: Path) -> None:
    left = temporary_path(tmp_path / "out" / "b" / "a").with_name(
        temporary_path(tmp_path / "a").name.replace(f"-{os.getpid()}-", "-4194305-")
    )
    left.mkdir(parents=True)
    with output_of(tmp_path).whole_folder("b/a") as folder:
        folder.write("new.txt", b"")
    assert list(left.parent.iterdir()) == [left.parent / "a"]


def test_leaving_out_counts(tmp_path: Path) -> None:
    output = output_of(tmp_path)
    for count in (2, 0, 3):
        output.leave_out("clouds", count)
    output.leave_out("maps", 0)
    output.leave_out("boxes")
    assert output.tally.left_out == Counter(clouds=5, boxes=1)


class TestLinks:
    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize("by_link", [False, True])
    def test_each_way(self, tmp_path: Path, source: Path, link: Link, by_link: bool) -> None:
        given = source
        if by_link:  # a release may be a tree of links
            given = tmp_path / "given.jpg"
            given.symlink_to(source.name)
        output = output_of(tmp_path, link)
        for _ in range(2):  # the second time over the first
            output.link(given, "a/b.png")
        target = tmp_path / "out" / "a" / "b.png"
        assert output.tally.linked == {link: 2}
        assert output.tally.files == 0
        assert target.read_bytes() == b"a picture"
        assert target.is_symlink() == (link == "symbolic")
        assert (not target.is_symlink() and target.samefile(source)) == (link == "hard")
        if link == "symbolic":
            assert target.readlink() == source
        assert list(target.parent.iterdir()) == [target]

    @pytest.mark.parametrize("code", [errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK])
    def test_the_next_way_where_one_cannot_be(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, code: int
    ) -> None:
        monkeypatch.setattr(os, "link", refusing(code))
        output = output_of(tmp_path)
        output.link(source, "a.jpg")
        monkeypatch.setattr(Path, "symlink_to", refusing(errno.EPERM))
        output.link(source, "b.jpg")
        assert output.tally.linked == Counter(symbolic=1, copy=1)
        assert (tmp_path / "out" / "a.jpg").is_symlink()
        assert not (tmp_path / "out" / "b.jpg").is_symlink()

    def test_a_copy_where_a_symbolic_link_would_tell_a_path(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        output = output_of(tmp_path)
        output.link(source, "a.jpg", symbolic=False)
        monkeypatch.setattr(os, "link", refusing(errno.EXDEV))
        output.link(source, "b.jpg", symbolic=False)
        assert output.tally.linked == Counter(hard=1, copy=1)
        assert not (tmp_path / "out" / "b.jpg").is_symlink()
        assert (tmp_path / "out" / "b.jpg").read_bytes() == source.read_bytes()

    @pytest.mark.parametrize("link", ["hard", "symbolic"])
    def test_a_full_disk_is_no_reason_for_another_way(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, link: Link
    ) -> None:
        monkeypatch.setattr(os, "link", refusing(errno.ENOSPC))
        monkeypatch.setattr(Path, "symlink_to", refusing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space left"):
            output_of(tmp_path, link).link(source, "a.jpg")
        assert names(tmp_path / "out") == []

    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (lambda _: None, r"cannot be read \(No such file or directory\)"),
            (os.mkfifo, r"not a regular file \(a named pipe\)"),
            (os.mkdir, r"not a regular file \(a folder\)"),
            (lambda path: path.symlink_to("nothing"), "No such file"),
            (lambda path: path.symlink_to(path.name), "Too many levels of symbolic links"),
        ],
        ids=["missing", "pipe", "folder", "link to nothing", "link to itself"],
    )
    def test_what_is_no_file(self, tmp_path: Path, make: Callable[[Path], None], words: str, link: Link) -> None:
        path = tmp_path / "odd.jpg"
        make(path)
        with pytest.raises(SensorFileError, match=rf"odd.jpg: .*{words}.*; restore it from its archive"):
            output_of(tmp_path, link).link(path, "a.jpg")
        assert not (tmp_path / "out").exists()
