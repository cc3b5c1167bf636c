"""One log replayed from file to files: what is told about it, also where something unforeseen goes wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from loopback import event

from adapters.logs.recordings import read_recording
from monitor.profile import read_profile
from replay.player import interests, play
from replay.runs.live_replay import LiveReplay
from replay.runs.one_log import LogOutcome, LogTask, replay_log

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
PROFILE = read_profile(QUAD)


def test_a_log_is_told_as_it_plays_also_as_if_live(data: Path) -> None:
    path = data / "copter_motor3_090.tlog.xz"
    read = list(read_recording(path, interests(PROFILE)))
    found = play(PROFILE, read)
    for live in (None, LiveReplay()):
        outcome = replay_log(PROFILE, LogTask("the flight", path), live=live)
        assert outcome.events == found.events
        assert (outcome.samples, outcome.evidence) == (found.samples, found.evidence)
        assert (outcome.start_ns, outcome.end_ns) == (read[0].received_ns, read[-1].received_ns)
        assert (outcome.log, outcome.kind, outcome.error) == ("the flight", "tlog", None)
        assert outcome.verdict.startswith("the flight: 1 alarm in 13 s of watched flight; inertial saw nothing")
        assert outcome.processor_s > 0.0


def test_outputs_are_written(data: Path, tmp_path: Path) -> None:
    out = [tmp_path / name for name in ("out.mcap", "out.png", "out.rrd")]
    outcome = replay_log(PROFILE, LogTask("a", data / "copter_5s.tlog.xz", "other", *out))
    assert outcome.error is None
    assert all(path.stat().st_size for path in out)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (KeyError("time"), "flight.tlog: KeyError: 'time' (in test_replay_one_log.py, line "),
        (MemoryError(), "flight.tlog: MemoryError: (in test"),
        (
            PermissionError(13, "Permission denied", "/somewhere/out.mcap"),
            "flight.tlog: /somewhere/out.mcap: Permission denied",
        ),
        (OSError("two\nlines"), "flight.tlog: two lines"),
    ],
)
def test_what_was_not_foreseen_is_one_line(
    error: Exception, line: str, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("replay.runs.one_log.play_batches", fail)
    outcome = replay_log(PROFILE, LogTask("flight.tlog", data / "copter_5s.tlog.xz"))
    assert outcome.error is not None
    assert outcome.error.startswith(line)
    assert "\n" not in outcome.error
    assert outcome.to_json()["error"] == outcome.error


def test_an_alarm_that_was_unshelved_is_counted_once() -> None:
    events = (event(1), event(2, state="shelved"), event(3), event(4, "motor2"), event(5, state="cleared"))
    assert LogOutcome(log="a", events=events).raised == (event(1), event(4, "motor2"))
