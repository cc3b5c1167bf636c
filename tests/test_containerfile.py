"""The Containerfile copies what the build needs, starts what there is, and the example configuration fits it."""

import json
import re
import shutil
import tomllib
from pathlib import Path

from fauio import build_parser
from monitor.configuration.config import read_config

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "Containerfile").read_text().replace("\\\n", " ")


def instructions(name: str) -> list[str]:
    return re.findall(rf"^\s*{name} (.+)$", TEXT, re.MULTILINE)


def copied() -> set[str]:
    return {path for line in instructions("COPY") if "--from" not in line for path in line.split()[:-1]}


def test_what_is_copied_is_there_and_all_that_the_build_takes() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for path in copied():
        assert (ROOT / path).exists(), path
    taken = [*build["project"]["license-files"], build["project"]["readme"], "pyproject.toml"]
    taken += [f"{module}.py" for module in build["tool"]["setuptools"]["py-modules"]]
    taken += [pattern.rstrip("*") for pattern in build["tool"]["setuptools"]["packages"]["find"]["include"]]
    taken += [path for paths in build["tool"]["setuptools"]["data-files"].values() for path in paths]
    for path in taken:
        assert any(path == one or path.startswith(f"{one}/") for one in copied()), f"{path} is not copied"


def test_it_has_the_lowest_python_that_is_supported_which_the_tests_run_with_and_a_compiler_only_to_build() -> None:
    lowest = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"].removeprefix(">=")
    (building, _, _), (shipped,) = (line.split() for line in instructions("FROM"))
    assert (building, shipped) == (f"python:{lowest}-bookworm", f"python:{lowest}-slim-bookworm")


def test_it_runs_the_daemon_as_nobody_special() -> None:
    (entry,), (command,) = instructions("ENTRYPOINT"), instructions("CMD")
    assert json.loads(entry) == ["fauio"]
    assert build_parser().parse_args(json.loads(command)).command == "run"
    assert instructions("USER")[-1].split(":")[0].isdigit()


def test_the_example_configuration_is_valid_and_opens_what_the_file_exposes(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "replay/data/quad", tmp_path / "quad")
    text = (ROOT / "examples/container.toml").read_text()
    path = tmp_path / "fauio.toml"
    path.write_text(text.replace("/var/lib/fauio", str(tmp_path)))
    config = read_config(path)
    assert config.profile == tmp_path / "quad"
    (exposed,) = instructions("EXPOSE")
    for port in re.findall(r"\d+", exposed):
        assert f":{port}" in text
    (health,) = instructions("HEALTHCHECK")
    assert f"http://{config.metrics.listen}/healthz" in json.loads(health.split("CMD ")[1])[-1]
