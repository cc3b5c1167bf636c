"""Unfinished recordings, after a crash: ``fauio recover`` and the starting daemon finish them."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, say, say_json
from adapters.errors import FauioError, StorageError, UsageError

if TYPE_CHECKING:
    from adapters.logs.mcap_recovery import Recovery


def unfinished(place: Path) -> Iterator[Path]:
    """Yield the unfinished MCAP files of a folder and its subfolders, or the given file itself."""
    from adapters.logs.mcap_recovery import is_unfinished

    for path in sorted(place.rglob("*.mcap")) if place.is_dir() else [place]:
        try:
            if is_unfinished(path):
                yield path
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error


def finish_all(folder: Path, say: Callable[..., None]) -> threading.Thread:
    """Finish the unfinished recordings of an earlier daemon in a folder, in a thread.

    ``say`` logs what was done. A file that is being written is left alone.
    """
    thread = threading.Thread(
        target=_finish_all, args=(folder, say, time.time()), name=f"finishing {folder}", daemon=True
    )
    thread.start()
    return thread


def _finish_all(folder: Path, say: Callable[..., None], begun_s: float) -> None:
    try:
        for done in _finished(path for path in unfinished(folder) if path.stat().st_mtime < begun_s):
            if isinstance(done, FauioError):
                say("recording unfinished", level="warning", reason=str(done))
            else:
                say("recording finished", path=str(done.path), messages=done.messages, cut_bytes=done.cut_bytes)
    except (FauioError, OSError) as error:
        say("recording unfinished", level="warning", reason=str(error))


def _finished(paths: Iterable[Path]) -> Iterator[Recovery | FauioError]:
    """Finish files; yield for each what was done, or why nothing could be done."""
    from adapters.logs.mcap_recovery import finish

    for path in paths:
        try:
            if (done := finish(path)) is not None:
                yield done
        except FauioError as error:
            yield error


def add_recover(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "recover",
        help="finish recordings that a crash or a power cut left unfinished",
        description="Add the missing index and end to unfinished MCAP files, in place; no message in them is lost. "
        "'fauio run' does the same with its own folders when it starts. Files that are being written are not changed.",
        epilog="example: fauio recover recordings/",
    )
    option(parser, "place FILE|FOLDER", "MCAP file, or folder with such files below it", Path)
    option(parser, "--json", "print the result as one JSON object")
    parser.set_defaults(handler=run_recover)


def _check_is_recording(place: Path) -> None:
    """Refuse a file that is no recording, or is empty."""
    from mcap.writer import MCAP0_MAGIC

    if place.is_dir():
        return
    try:
        with place.open("rb") as file:
            begins = file.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise UsageError(f"{place}: cannot be read: {error.strerror}") from error
    if begins != MCAP0_MAGIC:
        why = "not an MCAP file" if begins else "empty, nothing was recorded"
        raise UsageError(f"{place}: {why}; name a recording or a folder of recordings")


def run_recover(args: argparse.Namespace) -> int:
    """Finish the files; exit status 2 if some could not be finished."""
    if not args.place.exists():
        raise UsageError(f"{args.place}: no such file or folder")
    _check_is_recording(args.place)
    done = list(_finished(unfinished(args.place)))
    mistakes = [str(error) for error in done if isinstance(error, FauioError)]
    finished = [recording for recording in done if not isinstance(recording, FauioError)]
    if args.json:
        rows = [asdict(recording) | {"path": str(recording.path)} for recording in finished]
        say_json({"finished": rows, "not_finished": mistakes})
    else:
        for recording in finished:
            cut = (
                f"; its last {recording.cut_bytes} bytes were a record that was cut off" if recording.cut_bytes else ""
            )
            say(f"{recording.path}: finished, {recording.messages} messages{cut}")
        if not finished and not mistakes:
            say(f"{args.place}: nothing to finish")
    if mistakes and not args.json:
        raise StorageError("\n".join(mistakes))
    return 2 if mistakes else 0
