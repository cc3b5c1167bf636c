"""``fauio watch``: its options, and the loop that checks the folder."""

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from adapters.command_line import option, say, say_json

INDEX_FILE: Final = "index.html"
_EVERY_S: Final = 5.0
"""Period of the checks of the folder, seconds. Chosen: a report is read minutes after a landing; a check costs
milliseconds."""
_SETTLED_S: Final = 5.0
"""Time for which a log has to be unchanged before it is read, seconds. Chosen: a copy from a card or by radio writes
every second."""


def add_watch(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "watch",
        help="write a report of every new log in a folder",
        description="Look at a folder every few seconds. Replay each new or changed log with the profile, or review it "
        "if no profile is given; write its report, and a page with a table of all logs "
        f"({INDEX_FILE}). Runs until it is interrupted, and continues from its reports when it is started again.",
        epilog="example: fauio watch logs/ --profile quad/ -o reports/\nexample: fauio watch logs/ -o reports/ --once",
    )
    option(parser, "folder FOLDER", "folder of new logs, with its subfolders", Path)
    option(parser, "--profile PROFILE", "profile folder (default: logs are reviewed)", Path)
    option(parser, "-o --out OUT", "folder of the reports", Path, required=True)
    option(parser, "--once", "process the present logs and end")
    option(parser, "--json", "print one JSON object per log")
    parser.set_defaults(handler=run_watch)


def run_watch(args: argparse.Namespace) -> int:
    """Run ``fauio watch``."""
    from adapters.errors import UsageError
    from replay.runs.log_list import check_output_folder
    from replay.watch.folder_watch import FolderWatch

    if not args.folder.is_dir():
        raise UsageError(f"{args.folder}: is no folder; name the folder that logs come into")
    check_output_folder(args.out)
    args.out.mkdir(parents=True, exist_ok=True)
    watch = FolderWatch(args.folder, args.out, args.profile, settled_s=0.0 if args.once else _SETTLED_S)
    while True:
        for log in watch.look():
            if args.json:
                say_json(asdict(log))
            else:
                say(log.error or f"{log.log}: {log.verdict}")
        if args.once:
            return 0
        time.sleep(_EVERY_S)
