"""What is built holds what it should, and works installed into an environment of its own."""

import json
import os
import shutil
import socket
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Callable
from email.parser import Parser
from pathlib import Path

import pytest
from conftest import made_once

ROOT = Path(__file__).parent.parent
COMPILED = (".so", ".c")
"""What compiling the core leaves beside its sources."""
PACKAGES = ("adapters", "gains", "monitor", "replay")
ALONGSIDE = (".ci", "bench", "docs", "examples", "foxglove", "grafana", "systemd", "tests")
FILES = (
    "fauio.py",
    "setup.py",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "LICENSE",
    "NOTICE",
    "Makefile",
    "Containerfile",
)


def build(folder: Path, *options: str) -> None:
    """Build from a copy: nothing is left in the source tree, and nothing is taken that was built or compiled before."""
    source = folder / "source"
    before = shutil.ignore_patterns("__pycache__", ".*_cache", *(f"*{ending}" for ending in COMPILED))
    for name in (*PACKAGES, *ALONGSIDE):
        shutil.copytree(ROOT / name, source / name, ignore=before)
    for name in FILES:
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), *options, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    shutil.rmtree(source / "fauio.egg-info")
    for generated in source.rglob("*.c"):
        if generated.with_suffix(".pyx").exists():
            generated.unlink()


# The wheel compiles the core, some 50 s on an idle processor: more than the suite's timeout where others are busy.
pytestmark = pytest.mark.timeout(400)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with ``source/`` and both distributions built of it in ``dist/``."""
    return made_once(tmp_path_factory, "distributions", build)


@pytest.fixture(scope="module")
def source_built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with ``source/`` and the source distribution in ``dist/``: nothing has to be compiled for it."""
    folder = tmp_path_factory.mktemp("source_distribution")
    build(folder, "--sdist")
    return folder


def wheel(built: Path) -> Path:
    return next((built / "dist").glob("*.whl"))


def files_below(root: Path, *folders: str) -> set[str]:
    return {str(path.relative_to(root)) for folder in folders for path in (root / folder).rglob("*") if path.is_file()}


@pytest.mark.long
def test_the_wheel_holds_all_files_of_the_packages_the_core_compiled_and_nothing_else(built: Path) -> None:
    names = set(zipfile.ZipFile(wheel(built)).namelist())
    about = {name for name in names if name.startswith("fauio-")}
    sources = {"fauio.py", *files_below(built / "source", *PACKAGES)}
    cython = {name for name in sources if name.endswith((".pyx", ".pxd"))}
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    core = {name.removesuffix(".pyx") + suffix for name in cython if name.endswith(".pyx")}
    assert core
    assert {name.removesuffix(suffix) + ".pyi" for name in core} <= names
    assert names - about == (sources - cython) | core
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    assert {name.split("/", 1)[1] for name in about} == {
        "METADATA",
        "WHEEL",
        "RECORD",
        "entry_points.txt",
        "top_level.txt",
        "licenses/LICENSE",
        "licenses/NOTICE",
        "data/share/fauio/fauio@.service",
        "data/share/fauio/config-example.toml",
        "data/share/fauio/fauio-alerts.yml",
        "data/share/fauio/fauio-dashboard.json",
        "data/share/fauio/fauio-layout.json",
    }


@pytest.mark.long
def test_the_source_distribution_holds_all_that_builds_tests_and_documents_it(source_built: Path) -> None:
    with tarfile.open(next((source_built / "dist").glob("*.tar.gz"))) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert names >= files_below(source_built / "source", *PACKAGES, *ALONGSIDE) | set(FILES)
    assert not {name for name in names if name.startswith(PACKAGES) and name.endswith(COMPILED)}


@pytest.mark.long
def test_the_metadata_states_licences_and_python_and_invents_no_address(source_built: Path) -> None:
    with tarfile.open(next((source_built / "dist").glob("*.tar.gz"))) as archive:
        name = min((name for name in archive.getnames() if name.endswith("/PKG-INFO")), key=len)
        text = archive.extractfile(name)
        assert text is not None
        stated = Parser().parsestr(text.read().decode())
    assert stated["License-Expression"] == "Apache-2.0"
    assert stated.get_all("License-File") == ["LICENSE", "NOTICE"]
    assert stated["Requires-Python"] == ">=3.11"
    assert stated["Project-URL"] is None
    assert "Typing :: Typed" in stated.get_all("Classifier", [])


def test_the_notice_names_all_that_is_bundled_and_was_not_written_here() -> None:
    notice = (ROOT / "NOTICE").read_text()
    for folder in next((ROOT / "adapters").rglob("definitions")).iterdir():
        assert folder.name in notice, f"whose is {folder.name}, and under which licence?"
    for place in ("replay/data", "tests/data", "gains/models"):
        assert place in notice


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Install the wheel into an environment of its own; return what runs a program of it far from the source tree.

    Its libraries are those of the environment that runs the tests, by a path file behind its own packages, so that
    none is downloaded: what is missing from the metadata does not show here.
    """
    home = tmp_path_factory.mktemp("installed")
    venv.create(home / "env", symlinks=True)
    bin_ = home / "env" / "bin"
    (home / "work").mkdir()
    # a path to the source tree, as tests are run with, would be a fauio that is installed already
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= {"HOME": str(home), "PATH": f"{bin_}:{os.environ['PATH']}"}

    def run(program: str | Path, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [bin_ / program, *arguments],
            cwd=home / "work",
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )

    pip = ["-m", "pip", "--quiet", "--python", str(bin_ / "python"), "install", "--no-index", "--no-deps"]
    done = run(sys.executable, *pip, str(wheel(built)))
    assert done.returncode == 0, done.stderr
    site = run("python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip()
    (Path(site) / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return run


Run = Callable[..., subprocess.CompletedProcess[str]]


def free_ports() -> tuple[int, int]:
    with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        udp.bind(("127.0.0.1", 0))
        return tcp.getsockname()[1], udp.getsockname()[1]


@pytest.mark.long
def test_the_installed_packages_are_those_of_the_wheel(installed: Run) -> None:
    for package in ("fauio", *PACKAGES):
        done = installed("python", "-c", f"import {package}; print({package}.__file__)")
        assert "/env/lib/" in done.stdout, done.stderr


@pytest.mark.long
def test_the_installed_command_says_its_versions_and_looks_the_machine_over(installed: Run) -> None:
    said = installed("fauio", "--version")
    assert said.stdout.startswith("fauio 0."), said.stderr
    assert "numpy" in said.stdout
    tcp, udp = free_ports()
    places = ["--listen", f"tcp/127.0.0.1:{tcp}", "--mavlink", f"udpin:127.0.0.1:{udp}"]
    checks = json.loads(installed("fauio", "doctor", "--json", *places).stdout)["checks"]
    assert [check for check in checks if check["verdict"] == "failed"] == []
    assert {"version", "libraries"} <= {check["name"] for check in checks}


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        "--help",
        "check arm",
        "design arm --rate 100 -o arm.gains.json",
        "design arm-disturbed --continuous",
        "info arm.gains.json",
        "schema alarm",
        "completion bash",
    ],
)
def test_commands_that_need_no_recording_run_as_typed(installed: Run, command: str) -> None:
    done = installed("fauio", *command.split())
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout


@pytest.mark.long
def test_the_bundled_flight_is_described_and_replayed_with_the_bundled_profile(installed: Run) -> None:
    data = Path(installed("python", "-c", "import replay; print(replay.__path__[0])").stdout.strip()) / "data"
    quad, flight = str(data / "quad"), str(data / "copter_motor1.tlog.xz")
    for described in (quad, flight):
        assert installed("fauio", "info", described).returncode == 0
    files = ["--plot", "f.png", "--report", "f.html", "-o", "f.mcap", "--alarms", "f.jsonl"]
    done = installed("fauio", "replay", quad, flight, *files, "--fail-on-alarm")
    assert done.returncode == 4, done.stderr
    assert "motor1" in done.stdout
    assert installed("fauio", "info", "f.mcap").returncode == 0


@pytest.mark.long
@pytest.mark.timeout(400)
@pytest.mark.parametrize("vehicle", ["arm", "copter"])
def test_the_demonstration_runs(installed: Run, vehicle: str) -> None:
    done = installed("fauio", "demo", vehicle)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.timeout(400)
def test_users_of_the_installed_library_are_checked_against_its_types(installed: Run, tmp_path: Path) -> None:
    shutil.copy(ROOT / "tests/typed_api.py", tmp_path)
    python = installed("python", "-c", "import sys; print(sys.executable)").stdout.strip()
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--config-file=",
        # A single module cannot carry the marker of PEP 561 (docs/library.md).
        "--follow-untyped-imports",
        "--python-executable",
        python,
        "typed_api.py",
    ]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.timeout(400)
def test_the_source_distribution_can_run_its_own_tests(built: Path, tmp_path: Path) -> None:
    with tarfile.open(next((built / "dist").glob("*.tar.gz"))) as archive:
        archive.extractall(tmp_path, filter="data")
    source = next(tmp_path.iterdir())
    # What is compiled of the same files; compiling them once more would take a minute.
    with zipfile.ZipFile(wheel(built)) as package:
        for name in package.namelist():
            if name.endswith(".so"):
                package.extract(name, source)
    tests = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    environment = os.environ | {"PYTHONPATH": str(source)}
    for arguments in (["--collect-only", "tests"], ["tests/test_public_api.py"]):
        done = subprocess.run(
            [*tests, *arguments], cwd=source, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
