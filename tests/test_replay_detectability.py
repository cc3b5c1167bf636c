"""The sweep tells seen from missed, how fast, as what, and whether a row of windows is fit to tell at all."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fauio
from adapters.batch import pack
from adapters.errors import UsageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_batches, read_recording
from adapters.message import Message
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK
from monitor.profile import Profile
from monitor.views.palette import BLUE, PURPLE, rgba
from replay.attacks.attack import Attack
from replay.sensitivity.detectability import Detectability, Row, Sweep, detectability, result_lines
from replay.sensitivity.detectability_plot import plot_detectability
from replay.sensitivity.healthy import TrialWindow, free_spans, onsets, play_healthy
from replay.sensitivity.trial import Task, run_task

LOG = Path(__file__).parent / "data" / "copter_healthy_square.tlog.xz"
ROW = Row("motor1", "loss", 0.1, "share of the command", 5, 0, 1, 0.2, None, 0.5, ("motor2",), 0.01)


@pytest.fixture(scope="module")
def healthy_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the first part of a healthy flight."""
    path = tmp_path_factory.mktemp("healthy") / "copter.mcap"
    messages = list(read_recording(LOG))
    with MessageLogWriter(path) as writer:
        for message in messages:
            if message.received_ns < messages[0].received_ns + 25_000_000_000:
                writer.write(message)
    return path


@pytest.fixture(scope="module")
def found(quad_folder: Path, healthy_log: Path) -> Detectability:
    sweep = Sweep(channels=("motor2",), sizes=(0.002, 0.1), onsets=2, before_s=3.0, after_s=2.0)
    return detectability(quad_folder, healthy_log, sweep)


@pytest.fixture(scope="module")
def arm_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "arm.mcap"
    with MessageLogWriter(path) as writer:
        for message in arm_messages(simulate_arm(SCENARIOS["healthy"], 25.0, 100.0, "zero"), 10**18):
            writer.write(message)
    return path


@pytest.fixture(scope="module")
def arm_folder(tmp_path_factory: pytest.TempPathFactory, arm_profile: Profile) -> Path:
    folder = tmp_path_factory.mktemp("arm_profile")
    for name, content in arm_profile.files.items():
        (folder / name).write_bytes(content)
    return folder


def test_a_large_loss_is_seen_fast_and_alone_and_a_tiny_one_is_missed(found: Detectability) -> None:
    tiny, large = found.rows
    assert (tiny.missed, tiny.trials, tiny.delay_median_s, tiny.isolated) == (2, 2, None, None)
    assert (large.missed, large.trials, large.void, large.isolated, large.others) == (0, 2, 0, 1.0, ())
    assert large.delay_median_s is not None
    assert large.delay_90_s is not None
    assert 0.0 < large.delay_median_s <= large.delay_90_s < 0.5
    assert large.estimate_error is not None
    assert large.estimate_error < 0.02
    assert large.unit == "share of the command"
    assert found.healthy_alarms == 0


@pytest.mark.long
def test_more_processes_give_the_same_result(quad_folder: Path, healthy_log: Path, found: Detectability) -> None:
    sweep = Sweep(channels=("motor2",), sizes=(0.002, 0.1), onsets=2, before_s=3.0, after_s=2.0, jobs=2)
    assert detectability(quad_folder, healthy_log, sweep) == found


@pytest.mark.long
def test_sensors_of_a_users_own_plant_are_swept_around_their_threshold(arm_folder: Path, arm_log: Path) -> None:
    sweep = Sweep(onsets=1, before_s=9.0, after_s=2.0)
    result = detectability(arm_folder, arm_log, sweep)
    assert {(row.channel, row.kind) for row in result.rows} == {("encoder", "bias"), ("encoder", "ramp")}
    bias = [row for row in result.rows if row.kind == "bias"]
    assert [row.missed for row in bias] == sorted((row.missed for row in bias), reverse=True)
    assert bias[0].missed == 1
    assert bias[-1].delay_median_s is not None
    assert bias[-1].delay_median_s < 0.3
    assert all(row.estimate_error is not None and row.estimate_error < 0.1 for row in bias)
    assert any("motor" in reason and "nonlinear" in reason for reason in result.skipped)


def test_a_window_that_raises_by_itself_says_nothing_about_the_fault(quad_profile: Profile, data: Path) -> None:
    messages = tuple(read_recording(data / "copter_motor2_080.tlog.xz"))
    start_ns = 115_000_000_000
    late = Attack("motor1", "loss", start_ns, start_ns + 10**9, size=0.2)
    early = replace(late, channel="motor2", start_ns=111_000_000_000)
    for attack, delay in ((late, None), (early, pytest.approx(0.2, abs=0.2))):
        (outcome,) = run_task(Task(quad_profile, "motors", 1, TrialWindow(pack([]), messages), (attack,)))
        assert outcome.delay_s == delay


def test_delays_count_misses_as_never() -> None:
    from replay.sensitivity.detectability import _row
    from replay.sensitivity.trial import Outcome

    attack = Attack("motor1", "loss", 0, 1, size=0.1)
    seen = [Outcome(delay, frozenset(), 0.1) for delay in (0.4, 0.1, 0.2)]
    missed = [Outcome(float("inf"), frozenset({"motor2"}), 0.3)]
    row = _row(attack, "", [*seen, *missed, Outcome(None, frozenset(), None)])
    assert (row.trials, row.void, row.missed) == (4, 1, 1)
    assert (row.delay_median_s, row.delay_90_s) == (0.2, None)
    assert (row.isolated, row.others) == (1.0, ("motor2",))
    assert row.estimate_error == pytest.approx((0.03) ** 0.5)


@given(
    watched=st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 400)), max_size=4),
    alarms=st.lists(st.integers(0, 1400), max_size=3),
    before=st.integers(1, 60),
    after=st.integers(1, 60),
    count=st.integers(1, 8),
)
def test_every_window_is_watched_and_holds_no_alarm(
    watched: list[tuple[int, int]], alarms: list[int], before: int, after: int, count: int
) -> None:
    second = 10**9
    spans, end = [], 0
    for gap, length in watched:
        spans.append(((end + gap) * second, (end + gap + length) * second))
        end += gap + length + 1
    alarms_ns = [alarm * second for alarm in alarms]
    free = free_spans(spans, alarms_ns, before * second, after * second)
    places = onsets([(), free], count)
    found = [onset for _, onset in places]
    assert {recording for recording, _ in places} <= {1}
    assert len(found) <= count
    assert found == sorted(set(found))
    millisecond = 1_000_000
    for onset in found:
        low, high = onset - before * second, onset + after * second
        assert any(a - millisecond <= low and high <= b for a, b in spans)
        assert not any(low + millisecond < alarm < high for alarm in alarms_ns)


def test_a_window_knows_the_phase_of_flight_from_before(quad_profile: Profile) -> None:
    window = play_healthy(quad_profile, read_batches(LOG)).window(80_100_000_000, 80_120_000_000, 80_150_000_000)
    cut = window.messages()
    assert window.names == {message.name for message in cut}
    assert all(m.fields["time_boot_ms"] >= 80_120 for m in window.tail if m.name == "ATTITUDE")
    assert {message.name for message in cut[:3]} == {"HEARTBEAT", "EXTENDED_SYS_STATE", "GPS_RAW_INT"}
    times = [m.fields["time_boot_ms"] for m in cut if m.name == "ATTITUDE"]
    assert len(times) == 5
    assert 80_100 <= times[0] <= times[-1] < 80_150


def has_colour(path: Path, colour: str) -> bool:
    from matplotlib import image

    wanted = np.array(rgba(colour)[:3]) / 255.0
    return bool((np.abs(image.imread(path)[:, :, :3] - wanted).max(axis=2) < 0.01).any())


@pytest.mark.long
def test_the_picture_shows_delays_and_misses_and_draws_any_result(tmp_path: Path, found: Detectability) -> None:
    plot_detectability(tmp_path / "found.png", found)
    assert has_colour(tmp_path / "found.png", BLUE)
    assert has_colour(tmp_path / "found.png", PURPLE)
    odd = [
        replace(ROW, kind="freeze", size=None),
        replace(ROW, kind="scale", size=-1.0, missed=0),
        replace(ROW, channel="baro", trials=0, missed=0, delay_median_s=None, isolated=None),
        *(replace(ROW, channel=f"motor{n}", delay_90_s=0.0) for n in range(2, 8)),
    ]
    plot_detectability(tmp_path / "odd.png", replace(found, rows=tuple(odd)))
    plot_detectability(tmp_path / "none.png", replace(found, rows=()))


def test_the_table_says_what_the_rows_say(found: Detectability) -> None:
    lines = "\n".join(result_lines(replace(found, rows=(ROW, replace(ROW, void=2)), skipped=("no",), healthy_alarms=1)))
    for said in ("motor1", "1 of 5", "0.20 s", "never", "50 %", "motor2", "2 trials do not count", "left out: no"):
        assert said in lines
    assert "raises 1 alarm; is it healthy?" in lines


def test_the_command_prints_json_and_writes_the_picture(
    quad_folder: Path, healthy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(quad_folder), str(healthy_log), "--channel", "motor1", "--sizes", "0.2", "--onsets", "1"]
    arguments += ["--before", "2.5", "--after", "1", "--plot", str(tmp_path / "seen.png"), "--json"]
    assert fauio.main(["detectability", *arguments]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert (row["channel"], row["kind"], row["size"], row["miss_rate"]) == ("motor1", "loss", 0.2, 0.0)
    assert has_colour(tmp_path / "seen.png", BLUE)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--channel", "motor9"], "no such alarm"),
        (["--kinds", "shake"], "no such kind"),
        (["--channel", "motor1", "--kinds", "bias"], "use loss"),
        (["--channel", "motor1", "--sizes", "1.5"], "at most 1"),
        (["--before", "100"], "of watched flight"),
        (["--after", "0"], "above zero"),
    ],
)
def test_what_cannot_be_swept_is_refused_in_one_line(
    options: list[str], says: str, quad_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = LOG.with_name("copter_wind_step.tlog.xz")
    assert fauio.main(["detectability", str(quad_folder), str(log), *options]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


@pytest.mark.long
def test_the_sweep_follows_the_vehicle_that_the_pipeline_follows(
    quad_folder: Path, healthy_log: Path, tmp_path: Path, found: Detectability
) -> None:
    path = tmp_path / "two.mcap"
    stranger = partial(replace, system=9)
    with MessageLogWriter(path) as writer:
        for message in read_recording(healthy_log):
            writer.write(message)
            if message.name == "HEARTBEAT":
                writer.write(stranger(message))
        writer.write(Message(MAVLINK, "ATTITUDE", 0, {"roll": 0.0}, 9, 1))
    sweep = Sweep(channels=("motor2",), sizes=(0.1,), onsets=2, before_s=3.0, after_s=2.0)
    rows: Any = detectability(quad_folder, path, sweep).rows
    assert rows == found.rows[1:]


@pytest.mark.long
def test_a_sweep_without_any_fault_that_fits_says_why(quad_folder: Path, healthy_log: Path) -> None:
    with pytest.raises(UsageError, match="does not go with motor1"):
        detectability(quad_folder, healthy_log, Sweep(channels=("motor1",), kinds=("spoof",)))
