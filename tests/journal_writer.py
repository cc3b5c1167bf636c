"""Writes a journal until it is killed, and prints each event's number once it is written: python FILE."""

import sys
from itertools import count
from pathlib import Path

from loopback import event

from monitor.recording.journal import Journal


def main() -> None:
    journal = Journal(Path(sys.argv[1]))
    begun = journal.last_seq("copter-1")
    for seq in count(max(begun, 1)):
        alarm = seq // 3
        state = ("raised", "updated", "cleared")[seq % 3]
        # the last one before the kill comes again: it may or may not have been reported
        journal.write(event(seq, id=f"alarm-{alarm}", state=state), {"u": [0.5, seq]})
        sys.stdout.write(f"{seq}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
