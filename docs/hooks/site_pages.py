"""MkDocs events: adds the pages that are generated from the code, mends links that leave ``docs``, sets equations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from equations import typeset
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from reference import PAGES
from repository_links import PREFIX, repository_pages, rewritten


def on_files(files: Files, *, config: MkDocsConfig, **_: Any) -> Files:
    """Add generated pages, and the files of the repository that pages lead to."""
    texts = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    generated = {place: render() for place, render in PAGES.items()}
    for place, one in (generated | repository_pages(_root(config), texts)).items():
        if isinstance(one, Path):
            files.append(File.generated(config, place, abs_src_path=str(one)))
        else:
            files.append(File.generated(config, place, content=one))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Mend the links of a page of ``docs``; those of the repository's own pages are mended already."""
    if page.file.src_uri.startswith(f"{PREFIX}/"):
        return markdown
    return rewritten(_root(config), f"docs/{page.file.src_uri}", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Set the equations of a page."""
    return typeset(content)


def _root(config: MkDocsConfig) -> Path:
    return Path(config.docs_dir).parent
