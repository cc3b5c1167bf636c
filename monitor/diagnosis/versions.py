"""The installed versions of Python, of this program and of its libraries, and missing libraries."""

import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version

_REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)(\[[^]]*\])?\s*(>=(?P<least>[\d.]+))?[^;]*(;.*extra\s*==\s*['\"](?P<extra>\w+))?"
)


@dataclass(frozen=True, slots=True)
class Library:
    """A library that this program uses."""

    name: str  # its distribution
    extra: str  # extra that it belongs to; empty if it is always needed
    least: str  # least version that is accepted; empty if any is
    installed: str | None  # installed version; None if not installed

    @property
    def will_do(self) -> bool:
        """Whether it is installed and new enough."""
        return self.installed is not None and _numbers(self.installed) >= _numbers(self.least)


def libraries() -> Sequence[Library]:
    """Return all libraries that the metadata of the installed package name, those of extras last."""
    installed = []
    for text in requires("fauio") or ():
        match = _REQUIREMENT.match(text)
        if match is not None:
            name = match["name"]
            installed.append(Library(name, match["extra"] or "", match["least"] or "", installed_version(name)))
    return sorted(installed, key=lambda library: (library.extra, library.name))


def installed_version(name: str) -> str | None:
    """Return the version of a distribution, or None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def version_text() -> str:
    """Return what ``fauio --version`` prints: this program in the first line, a library in each of the others."""
    lines = [f"fauio {version('fauio')} (Python {platform.python_version()}, {platform.system()} {platform.machine()})"]
    installed = {library.name: library.installed for library in libraries() if library.installed is not None}
    width = max(map(len, installed), default=0)
    lines += [f"  {name:<{width}}  {number}" for name, number in sorted(installed.items())]
    return "\n".join(lines) + "\n"


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", re.match(r"[\d.]*", text)[0]))  # type: ignore[index]
