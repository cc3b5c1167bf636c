"""Links from pages to files of the repository outside ``docs``: such files become pages of the site, too.

A page in ``docs`` links as the repository is laid out, so that its links work there, in any clone: ``../README.md``,
``../examples/zenoh``. On the site a Markdown file stands at ``repository/<path>``, a picture as it is, any other
file as a page that shows its text, and a folder as a list of its files.
"""

from __future__ import annotations

import os.path
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from markup import block

PREFIX = "repository"
_DOCS = "docs"
_LANGUAGES = {"json5": "json", "service": "ini", "py": "python", "sh": "bash", "ts": "typescript", "rs": "rust"}
_COPIED = (".png", ".svg", ".jpg", ".webp", ".pdf")
_LINK = re.compile(
    r"^(?P<fence>`{3,}|~{3,})[^\n]*\n.*?^(?P=fence)[ \t]*$"
    r"|(?P<ticks>`+)(?!`)(?:(?!\n\n).)+?(?<!`)(?P=ticks)(?!`)"
    r"|(?<=\]\()(?P<inline>[^)\s]+)(?=(?:\s+\"[^\"]*\")?\))"
    r"|(?<=^)\[[^\]]+\]:[ \t]+(?P<defined>\S+)"
    r"|\b(?:src|href|srcset)=\"(?P<attribute>[^\"]+)\"",
    re.MULTILINE | re.DOTALL,
)
_TARGETS = ("inline", "defined", "attribute")


def link_targets(text: str) -> Iterator[str]:
    """Yield the targets of a Markdown text's links and images, without those in code."""
    for match in _LINK.finditer(text):
        yield from (match[kind] for kind in _TARGETS if match[kind])


def is_outside_link(target: str) -> bool:
    """Return whether a link leads to another site, or is an address."""
    return re.match(r"[a-z][a-z0-9+.-]*:|//", target) is not None


def resolved(page: str, target: str) -> tuple[str, str]:
    """Return path in the repository and anchor that a link of a page leads to."""
    path, _, anchor = target.partition("#")
    return (os.path.normpath(PurePosixPath(page).parent / path) if path else page), anchor


def repository_pages(root: Path, docs: Mapping[str, str]) -> dict[str, str | Path]:
    """Return what stands on the site for the files outside ``docs`` that pages lead to, directly or over others.

    Parameters
    ----------
    root : Path
        The repository.
    docs : Mapping[str, str]
        Text of each page below ``docs``, by its path in the repository.

    Returns
    -------
    dict[str, str | Path]
        By path on the site the text of a page, or the file that is copied.
    """
    found: dict[str, str | Path] = {}
    waiting = dict(docs)
    while waiting:
        page, text = waiting.popitem()
        for target in link_targets(text):
            path, _ = resolved(page, target)
            if is_outside_link(target) or _is_in_docs(path) or path in found or not (root / path).exists():
                continue
            if _is_copied(path):
                found[path] = root / path
            else:
                found[path] = waiting[_markdown_of(root, path)] = _content(root, path)
    return {
        site_path(root, path): rewritten(root, _markdown_of(root, path), one) if isinstance(one, str) else one
        for path, one in found.items()
    }


def rewritten(root: Path, page: str, text: str) -> str:
    """Return a page's text with its links as they have to be on the site.

    Parameters
    ----------
    root : Path
        The repository.
    page : str
        Path of the page in the repository.
    text : str
        Its Markdown.
    """
    return _LINK.sub(_mending(root, page), text)


def site_path(root: Path, path: str) -> str:
    """Return where a file or folder of the repository stands on the site."""
    if _is_in_docs(path):
        return str(PurePosixPath(path).relative_to(_DOCS))
    if (root / path).is_dir():
        return f"{PREFIX}/{_markdown_of(root, path)}"
    return f"{PREFIX}/{path}" if path.endswith(".md") or _is_copied(path) else f"{PREFIX}/{path}.md"


def _mending(root: Path, page: str) -> Callable[[re.Match[str]], str]:
    here = PurePosixPath(site_path(root, page)).parent

    def mended(match: re.Match[str]) -> str:
        target = next((match[kind] for kind in _TARGETS if match[kind]), None)
        if target is None or is_outside_link(target) or target.startswith("#"):
            return match[0]
        path, anchor = resolved(page, target)
        if not (root / path).exists() or (_is_in_docs(path) and _is_in_docs(page)):
            return match[0]
        there = os.path.relpath(site_path(root, path), here)
        return match[0].replace(target, f"{there}#{anchor}" if anchor else there)

    return mended


def _is_in_docs(path: str) -> bool:
    return PurePosixPath(path).parts[:1] == (_DOCS,)


def _markdown_of(root: Path, path: str) -> str:
    """Return the Markdown file that stands for a file or folder."""
    if (root / path).is_dir():
        return f"{path}/README.md" if (root / path / "README.md").is_file() else f"{path}/index.md"
    return path


def _is_copied(path: str) -> bool:
    return PurePosixPath(path).suffix in _COPIED


def _content(root: Path, path: str) -> str:
    source = root / _markdown_of(root, path)
    if source.suffix == ".md" and source.is_file():
        return source.read_text(encoding="utf-8")
    if (root / path).is_dir():
        names = sorted(one.name for one in (root / path).iterdir() if one.is_file())
        return "\n".join([f"# {path}", "", *(f"- [`{name}`]({name})" for name in names)]) + "\n"
    suffix = source.suffix.removeprefix(".")
    return f"# {path}\n\n{block(source.read_text(encoding='utf-8'), _LANGUAGES.get(suffix, suffix or 'text'))}\n"
