"""The suite's processes: all that their tests say is reported once, and one that dies is no success."""

import subprocess
import sys
from pathlib import Path

TESTS = """
import os, pytest

@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")

@pytest.mark.parametrize("number", range(3))
def test_passes(shared, number):
    print("said", number)

def test_fails(shared):
    print("said in vain")
    assert shared is None
"""


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-p", "processes", "-p", "no:cacheprovider", "--processes", "2"]
    environment = {"PYTHONPATH": str(Path(__file__).parent), "PATH": ""}
    return subprocess.run(
        [*command, *arguments, "."], check=False, cwd=folder, env=environment, capture_output=True, text=True
    )


def test_what_tests_say_in_all_processes_is_reported_once(tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / f"test_{name}.py").write_text(TESTS)
    ended = run(tmp_path, "-q")
    assert ended.returncode == 1
    assert "3 failed, 9 passed" in ended.stdout
    assert [f"FAILED test_{name}.py::test_fails" in ended.stdout for name in "abc"] == [True] * 3
    assert ended.stdout.count("\nsaid in vain") == 3
    ended = run(tmp_path, "-q", "-x")
    assert (ended.returncode, ended.stdout.count("\nFAILED")) == (1, 1)


def test_a_process_that_dies_is_an_error_that_names_its_file(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text(TESTS.replace("assert shared is None", "os._exit(0)"))
    ended = run(tmp_path)
    assert ended.returncode not in (0, 1)
    assert "a process of the suite died in or after test_a.py::test_fails" in ended.stdout + ended.stderr
