"""Documentation: every relative link and anchor leads somewhere, and generated pages say what the code takes."""

import argparse
import re
import shutil
import tomllib
from functools import cache
from pathlib import Path

import pytest
import tomli_w
from markup import table
from reference import PAGES
from repository_links import is_outside_link, link_targets, repository_pages, resolved, rewritten, site_path

import fauio
from adapters.errors import ModelError, ProfileError
from adapters.toml_tables import TomlFile
from gains.plants.model_file import read_plant
from monitor.profile import read_profile

ROOT = Path(__file__).parents[1]
FOLDERS = ("docs", "examples")
WRITTEN = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (
        ROOT / "README.md",
        ROOT / "SECURITY.md",
        *(one for folder in FOLDERS for one in sorted((ROOT / folder).rglob("*.md"))),
    )
}
PROFILE = ROOT / "replay/data/quad"
MODEL = ROOT / "gains/models/arm-disturbed.toml"


@cache
def generated() -> dict[str, str]:
    return {f"docs/{place}": render() for place, render in PAGES.items()}


@cache
def texts() -> dict[str, str]:
    """Return all pages of the site, those that people wrote and those that are made from the code."""
    return WRITTEN | generated()


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    without_code = re.sub(r"^(`{3,})[^\n]*\n.*?^\1$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", without_code, re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).strip().replace(" ", "-") for heading in plain}


def lost(page: str, target: str) -> str | None:
    """Return what is wrong with a link of a page, None where it leads somewhere."""
    path, anchor = resolved(page, target)
    if path not in texts() and not (ROOT / path).exists():
        return f"{target}: no such file"
    if anchor and path in texts() and anchor not in anchors(texts()[path]):
        return f"{target}: no such heading"
    is_in_docs = page.startswith("docs/") and path.startswith("docs/")
    if is_in_docs and path not in texts() and not (ROOT / path).is_file():
        return f"{target}: a folder below docs has no page"
    return None


def keys_of(page: str, section: str) -> set[str]:
    """Return the keys that a section of a generated page documents, without those of tables further inside."""
    part = generated()[f"docs/reference/{page}.md"].split(f"\n{section}\n", 1)[1].split("\n## ")[0]
    cells = [line.split(" | ")[0] for line in part.splitlines() if line.startswith("| `")]
    return {key for cell in cells for key in re.findall(r"`([^`.]+)`", cell)}


def test_every_relative_link_leads_to_a_file_and_a_heading() -> None:
    links = [(page, target) for page, text in texts().items() for target in link_targets(text)]
    assert len(links) > 200
    inside = [(page, target) for page, target in links if not is_outside_link(target)]
    assert [f"{page}: {found}" for page, target in inside if (found := lost(page, target))] == []
    # no page names a place where the site would be hosted
    assert [f"{page}: {target}" for page, target in links if target.startswith("/")] == []


def test_links_in_code_are_no_links() -> None:
    text = "`[a](b.md)` [c](d.md)\n\n```\n[e](f.md)\n```\n\n[g]: h.md\n"
    assert list(link_targets(text)) == ["d.md", "h.md"]


def test_files_outside_docs_that_pages_lead_to_become_pages(tmp_path: Path) -> None:
    (tmp_path / "docs/how-to").mkdir(parents=True)
    (tmp_path / "examples/bus").mkdir(parents=True)
    (tmp_path / "docs/zenoh.md").write_text("# Zenoh\n")
    (tmp_path / "README.md").write_text("[zenoh](docs/zenoh.md)\n")
    (tmp_path / "examples/bus/one.toml").write_text("a = 1\n")
    (tmp_path / "examples/plot.png").write_bytes(b"PNG")
    page, text = "docs/how-to/bus.md", "[r](../../README.md) [b](../../examples/bus) ![p](../../examples/plot.png)"
    (tmp_path / page).write_text(text)
    made = repository_pages(tmp_path, {page: text})
    assert made["repository/README.md"] == "[zenoh](../zenoh.md)\n"
    assert made["repository/examples/bus/index.md"] == "# examples/bus\n\n- [`one.toml`](one.toml.md)\n"
    assert made["repository/examples/bus/one.toml.md"] == "# examples/bus/one.toml\n\n```toml\na = 1\n```\n"
    assert made["repository/examples/plot.png"] == tmp_path / "examples/plot.png"
    assert rewritten(tmp_path, page, text) == (
        "[r](../repository/README.md) [b](../repository/examples/bus/index.md) ![p](../repository/examples/plot.png)"
    )
    assert site_path(tmp_path, "docs/zenoh.md") == "zenoh.md"


def test_a_table_drops_empty_columns_and_keeps_bars_in_cells() -> None:
    assert table(("a", "b", "c"), [("1|2", "", "3")]) == "| a | c |\n| --- | --- |\n| 1\\|2 | 3 |"


@pytest.mark.parametrize(
    ("section", "place"),
    [
        ("## Top level", ()),
        ("## `[phase]`", ("phase",)),
        ("## `alarms.CHANNEL`", ("observers", "motors", "alarms", "motor1")),
        ("Method `bank`:", ("observers", "motors", "isolation")),
    ],
)
def test_the_reference_has_the_keys_that_a_profile_takes(section: str, place: tuple[str, ...], tmp_path: Path) -> None:
    shutil.copytree(PROFILE, tmp_path / "quad")
    document = tomllib.loads((PROFILE / "profile.toml").read_text())
    found = document
    for key in place:
        found = found[key]
    found["nonsense"] = 1
    (tmp_path / "quad/profile.toml").write_text(tomli_w.dumps(document))
    with pytest.raises(ProfileError, match="nonsense") as raised:
        read_profile(tmp_path / "quad")
    known = set(str(raised.value).partition("known here: ")[2].split(", "))
    assert keys_of("profile", section) - {"method"} == known - {"excuses", "observers", "phase", "method"}


@pytest.mark.parametrize(
    ("section", "table_name"),
    [("## Top level", None), ("## `[[nonlinearity]]`", "nonlinearity"), ("## `[[fault]]`", "fault")],
)
def test_the_reference_has_the_keys_that_a_model_takes(section: str, table_name: str | None) -> None:
    document = tomllib.loads(MODEL.read_text())
    (document if table_name is None else document[table_name][0])["nonsense"] = 1
    with pytest.raises(ModelError, match="nonsense' is not a key of this table") as raised:
        read_plant(TomlFile("model.toml", document, ModelError))
    known = set(str(raised.value).partition("known here: ")[2].split(", "))
    tables = {"nonlinearity", "fault", "disturbance", "noise", "error"}
    assert keys_of("model", section) - known == set()
    assert known - keys_of("model", section) <= tables


def test_the_reference_names_every_command_option_and_exit_status() -> None:
    page = generated()["docs/reference/commands.md"]
    (commands,) = (one for one in fauio.build_parser()._actions if isinstance(one, argparse._SubParsersAction))
    for name, parser in commands.choices.items():
        part = page.split(f"\n## fauio {name}\n", 1)[1].split("\n## ")[0]
        options = {option for action in parser._actions for option in action.option_strings} - {"-h", "--help"}
        assert [option for option in options if option not in part] == []
    statuses = generated()["docs/reference/exit-status.md"]
    assert [status for status in (0, 2, 3, 4, fauio.INTERRUPTED) if f"| `{status}` |" not in statuses] == []
