"""A file is written whole or stays as it was; a disk that takes no more is named with the file it failed for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from adapters.output_file import json_text, naming, write_file

FULL_DISK = """
import resource, signal, sys
from adapters.output_file import write_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    write_file(sys.argv[1], b"y" * 5000)
except OSError as error:
    print(error.filename)
"""


def test_what_cannot_be_written_whole_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    write_file(path, "before")
    done = subprocess.run([sys.executable, "-c", FULL_DISK, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout == f"{path}\n"
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_and_its_files_mode_stay(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "b"
    write_file(path, b"1")
    path.chmod(0o640)
    link.symlink_to(path)
    write_file(link, "naïve")
    assert link.is_symlink()
    assert path.read_text(encoding="utf-8") == "naïve"
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_file_whose_folder_takes_no_other_is_written_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_text("before")
    place = path.stat().st_ino

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("adapters.output_file._replace", refuse)
    write_file(path, "after")
    assert (path.read_text(), path.stat().st_ino) == ("after", place)
    with pytest.raises(PermissionError) as found:
        write_file(tmp_path / "new", "after")
    assert found.value.filename == str(tmp_path / "new")


def test_what_is_no_file_is_written_to_as_it_comes(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", pipe], stdout=subprocess.PIPE) as reader:
        write_file(pipe, "through")
        assert reader.communicate(timeout=10)[0] == b"through"
    done = subprocess.run(
        [sys.executable, "-c", "from adapters.output_file import write_file; write_file('/dev/stdout', 'said')"],
        capture_output=True,
        check=True,
    )
    assert done.stdout == b"said"
    with pytest.raises(OSError, match=r"No space left on device: '/dev/full'"):
        write_file("/dev/full", "lost")


def test_an_error_without_a_number_stays_as_it_is() -> None:
    with pytest.raises(OSError, match=r"^strange$"), naming("a"):
        raise OSError("strange")


def test_json_has_short_arrays_and_objects_on_a_line_and_the_same_content() -> None:
    content = {"size": [1.5, 2], "at": {"x": 1}, "said": ["a [b"], "long": list(range(100)), "in": [{"a": []}]}
    text = json_text(content)
    assert json.loads(text) == content
    assert text.startswith('{\n "size": [1.5, 2],\n "at": {"x": 1},\n')
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.timeout(5)
def test_the_time_to_lay_out_json_does_not_grow_with_the_lines_before_an_inner_array() -> None:
    content = {"a": {"b": {"c": {"d": {f"k{n}": n for n in range(1000)} | {"inner": [{"x": 1}]}}}}}
    assert json.loads(json_text(content)) == content
