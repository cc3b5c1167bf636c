"""Which recordings the arguments of a command name, and which file each of them is to be written to."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from adapters.errors import StorageError, TelemetryError, UsageError
from adapters.logs.recordings import recording_kind, session_files
from adapters.output_file import check_suffix

PLACE = "{log}"


@dataclass(frozen=True, slots=True)
class LogFile:
    """A recording."""

    path: Path  # file, or folder of a session
    # what files about it are called: its own name without suffixes, with the folders below the one that was given; no
    # two recordings of a list share it
    name: str


def find_logs(arguments: Sequence[Path]) -> list[LogFile]:
    """Return the recordings that arguments name, in their order.

    A file, and the folder of a recorded session, is one recording. Any other folder stands for all recordings in it and
    below, sorted by path; several MCAP files of one session in a folder are one recording there, too. Raises
    TelemetryError where a file is missing or no recording, or a folder holds none.
    """
    logs: list[LogFile] = []
    taken: set[str] = set()
    for argument in arguments:
        paths = _below(argument) if argument.is_dir() else [argument]
        if argument.is_dir() and not paths:
            raise TelemetryError(f"{argument}: no recording in this folder or below")
        for path in paths:
            recording_kind(path)
            # the folder that was given is left out of the name, unless it is the recording
            inside = path.relative_to(argument).parts or (path.name,)
            base = name = "_".join((*inside[:-1], _stem(path)))
            number = 1
            while name in taken:
                number += 1
                name = f"{base}-{number}"
            taken.add(name)
            logs.append(LogFile(path, name))
    return logs


def target(option: str, given: str | None, log: LogFile, suffix: str, *, many: bool) -> Path | None:
    """Return the file to write about a log; None where nothing was asked for.

    ``given`` is what the user gave to the option: a file; a folder, whose files have this suffix; or a name with
    ``{log}`` in the log's name's place. Among many logs a name without suffix is a folder, too. Raises UsageError where
    one file was given for several logs or its name says another kind, OSError where a folder cannot be made.
    """
    if given is None:
        return None
    if PLACE in given:
        path = Path(given.replace(PLACE, log.name))
    elif given.endswith(os.sep) or Path(given).is_dir() or (many and not Path(given).suffix):
        path = Path(given) / f"{log.name}{suffix}"
    elif many:
        raise UsageError(
            f"{option} {given}: takes one log at a time; give a folder, or a name with {PLACE} in it, for several"
        )
    else:
        if Path(given) != log.path:  # which is refused for a better reason
            check_suffix(Path(given), suffix)
        return Path(given)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def check_outputs(logs: Sequence[LogFile], targets: Sequence[Path], twice: str) -> None:
    """Raise, before long work, where files could not be written, or one of them is one of the logs.

    UsageError with the text ``twice`` is raised where two have one name, else StorageError.
    """
    if len({path.resolve() for path in targets}) < len(targets):
        raise UsageError(twice)
    parts = (path for log in logs if log.path.is_dir() for path in session_files(log.path))
    read = {path.resolve() for path in (*(log.path for log in logs), *parts)}
    for path in targets:
        if path.resolve() in read:
            raise StorageError(f"{path}: is one of the logs and would be overwritten; write somewhere else")
    for path in targets:
        check_output(path)


def check_output(path: Path) -> None:
    """Raise StorageError, before long work, where a file could not be written."""
    if path.is_dir():
        raise StorageError(f"{path}: is a folder; name a file to write")
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}; make it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise StorageError(f"{path}: this user may not write there; choose another place")


def check_output_folder(folder: Path) -> None:
    """Raise StorageError, before long work, where a folder could be neither written to nor made."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise StorageError(f"{folder}: {there} is a file; name a folder to write")
    if not os.access(there, os.W_OK):
        raise StorageError(f"{folder}: this user may not write to {there}; choose another place")


def _below(folder: Path) -> list[Path]:
    """Return the recordings in a folder and below; the folder itself where that is all there is."""
    paths = sorted(path for place, _, files in os.walk(folder) for path in _inside(Path(place), files))
    # one file is a session, too, and named by its folder where that was named
    return [folder] if len(paths) == 1 and _session(folder) and paths[0].parent == folder else paths


def _inside(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Return the recordings in a folder itself."""
    is_session = len(_session(folder)) > 1
    if is_session:
        yield folder
    for name in names:
        kind = _kind(folder / name)
        if kind and not (is_session and kind == "mcap"):
            yield folder / name


def _session(folder: Path) -> Sequence[Path]:
    try:
        return session_files(folder)
    except TelemetryError:
        return ()


def _kind(path: Path) -> str:
    try:
        return recording_kind(path)
    except TelemetryError:
        return ""


def _stem(path: Path) -> str:
    if path.is_dir():
        return path.resolve().name
    name = path.with_suffix("") if path.suffix.lower() in (".xz", ".gz") else path
    return name.stem
