"""The recordings that the arguments of a command name, and the file that is written about each of them."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from adapters.errors import StorageError, TelemetryError, UsageError
from adapters.logs.recordings import recording_kind, session_files, uncompressed
from adapters.output_file import check_suffix

PLACE = "{log}"


@dataclass(frozen=True, slots=True)
class LogFile:
    """A recording."""

    path: Path  # file, or folder of a session
    # name for files about it: its own name without suffixes, with the folders below the given one; no two recordings of
    # a list share a name
    name: str


def find_logs(arguments: Sequence[Path]) -> list[LogFile]:
    """Return the recordings that arguments name, in their order.

    A file, and the folder of a recorded session, is one recording. Any other folder stands for all recordings in it and
    below, sorted by path; several MCAP files of one session in a folder are one recording there, too. Raises
    TelemetryError if a file is missing or no recording, or a folder has none.
    """
    logs: list[LogFile] = []
    taken: set[str] = set()
    for argument in arguments:
        paths = _below(argument) if argument.is_dir() else [argument]
        if argument.is_dir() and not paths:
            raise TelemetryError(f"{argument}: no recording in this folder or below")
        for path in paths:
            recording_kind(path)
            # the given folder is left out of the name, unless it is the recording
            inside = path.relative_to(argument).parts or (path.name,)
            stem = path.resolve().name if path.is_dir() else uncompressed(path).stem
            base = name = "_".join((*inside[:-1], stem))
            number = 1
            while name in taken:
                number += 1
                name = f"{base}-{number}"
            taken.add(name)
            logs.append(LogFile(path, name))
    return logs


def target(option: str, given: str | None, log: LogFile, suffix: str, *, many: bool) -> Path | None:
    """Return the file to write about a log; None if none was asked for.

    ``given`` is the user's value of the option: a file; a folder, whose files have this suffix; or a name with
    ``{log}`` in place of the log's name. For several logs a name without suffix is a folder, too. Raises UsageError if
    one file was given for several logs or its suffix is another, OSError if a folder cannot be made.
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
        if Path(given) != log.path:  # the log itself is refused later, for a better reason
            check_suffix(Path(given), suffix)
        return Path(given)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def check_outputs(logs: Sequence[LogFile], targets: Sequence[Path], twice: str) -> None:
    """Raise an error, before long work, if a file cannot be written, or is one of the logs.

    UsageError with the text ``twice`` is raised if two files have one name, otherwise StorageError.
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
    """Raise StorageError, before long work, if a file could not be written."""
    if path.is_dir():
        raise StorageError(f"{path}: is a folder; name a file to write")
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}; make it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise StorageError(f"{path}: this user may not write there; choose another place")


def check_output_folder(folder: Path) -> None:
    """Raise StorageError, before long work, if a folder could be neither written to nor made."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise StorageError(f"{folder}: {there} is a file; name a folder to write")
    if not os.access(there, os.W_OK):
        raise StorageError(f"{folder}: this user may not write to {there}; choose another place")


def _below(folder: Path) -> list[Path]:
    """Return the recordings in a folder and below; the folder itself if it is one recording."""
    paths = sorted(path for place, _, files in os.walk(folder) for path in _inside(Path(place), files))
    # a single file is a session, too, named by its folder if the folder was given
    return [folder] if len(paths) == 1 and _session(folder) and paths[0].parent == folder else paths


def _inside(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Return the recordings in a folder, without the folders below."""
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
