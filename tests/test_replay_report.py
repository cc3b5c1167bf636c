"""The report of a run: well-formed, complete without network, and honest about what was not checked."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path

import pytest

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import packed
from adapters.message import Message
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK
from monitor.profile import Profile
from replay.player import play_batches
from replay.reports.findings import findings
from replay.reports.recording_facts import RecordingMeter
from replay.reports.report import Run, recording_report

DURATION_S = 30.0
START_NS = 10**18
VOID = {"meta", "br", "img", "link", "hr"}
LOADING = {"href", "src", "srcset", "xlink:href", "data", "action", "poster", "background"}
HOSTILE = """"><script>alert(1)</script><img src=http://evil.example onerror=x> $\\frac{$ & '\x1b[2J"""


class Page(HTMLParser):
    """Reads a page strictly: every element is closed in order; keeps its text and what it would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.loads: list[str] = []
        self.handlers: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self.loads += [value or "" for name, value in attrs if name in LOADING]
        self.loads += [url for _, value in attrs for url in re.findall(r"url\((.*?)\)", value or "")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def arm_run(profile: Profile, folder: Path, scenario: str) -> Run:
    """Return a run of the reference arm."""
    simulated = simulate_arm(SCENARIOS[scenario], DURATION_S, 100.0, "zero")
    return run_of(profile, folder, arm_messages(simulated, START_NS))


def run_of(profile: Profile, folder: Path, messages: Iterator[Message]) -> Run:
    """Return a run over messages."""
    log, meter = folder / "arm.mcap", RecordingMeter()
    log.write_bytes(b"0123456789")
    replay = play_batches(profile, meter.watch(packed(messages)), keep_traces=True)
    return Run(profile, folder, log, "arm-1", "what was found", replay, meter.facts())


@pytest.fixture(scope="module")
def faulty(arm_profile: Profile, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return arm_run(arm_profile, tmp_path_factory.mktemp("faulty"), "case2")


@pytest.fixture(scope="module")
def healthy(arm_profile: Profile, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return arm_run(arm_profile, tmp_path_factory.mktemp("healthy"), "healthy")


def scripts(html: str) -> list[str]:
    """Return the scripts that a page runs."""
    return re.findall(r"<script>(.*?)</script>", html, re.DOTALL)


def test_a_report_is_well_formed_loads_nothing_and_runs_its_own_charts_alone(faulty: Run) -> None:
    html = recording_report(faulty)
    page = Page(html)
    assert html.startswith("<!DOCTYPE html>")
    assert page.loads == []
    assert page.handlers == []
    assert not page.tags & {"iframe", "object", "embed", "link", "img", "form"}
    assert "@import" not in html
    assert "default-src 'none'" in html
    [policy] = re.findall(r"script-src ([^\"]*)", html)
    own = {f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts(html)}
    assert len(own) == 2
    assert own == set(policy.split())


def test_a_report_is_for_light_and_dark_and_paper(faulty: Run) -> None:
    html = recording_report(faulty)
    assert "@media (prefers-color-scheme: dark)" in html
    assert "@media print" in html
    assert "--series0" in html


def test_a_faulty_run_is_told_with_time_size_and_what_to_check(faulty: Run) -> None:
    html = recording_report(faulty)
    page = Page(html)
    raised = [event for event in faulty.replay.events if event.state == "raised"]
    assert raised
    for event in raised:
        assert f"{event.observer} / {event.channel}: " in page.text
    for part in (
        *("when 2001-09-09T01:4", "s in the charts, vehicle's clock", "how long", "how large"),
        *("two standard deviations", "severity", "10 bytes", faulty.profile.digest, "numpy", "messages"),
    ):
        assert part in page.text
    assert "No alarm was raised" not in page.text
    # the sentence at the top says what, when and how large, as the alarm's own does
    worst = next(one for one in findings(faulty.profile, faulty.replay.events, faulty.replay.traces))
    assert f"{worst.message} from 01:4"[1:] in page.text
    assert html.count("data-chart=") >= len(raised)


def test_a_healthy_run_says_what_that_covers_and_what_not(healthy: Run) -> None:
    page = Page(recording_report(healthy))
    assert healthy.replay.events == ()
    assert "No alarm was raised. That covers the channels below" in page.text
    assert "faults of any other kind, and smaller ones" in page.text
    assert "other explanations" not in page.text


def test_a_recording_without_the_profile_s_messages_says_that_it_says_nothing(
    arm_profile: Profile, tmp_path: Path
) -> None:
    nothing = run_of(arm_profile, tmp_path, iter([Message(MAVLINK, "HEARTBEAT", START_NS, {}, 1, 1)]))
    page = Page(recording_report(nothing))
    assert "This says nothing about the vehicle" in page.text
    assert "the recording has no" in page.text
    assert "there is nothing to draw" in page.text
    assert "figure" not in page.tags


def test_no_alarm_is_not_called_good_where_an_observer_watched_nothing(healthy: Run) -> None:
    [(name, watch)] = healthy.replay.watches.items()
    watches = {name: watch, "second": replace(watch, evidence=0)}
    half = recording_report(replace(healthy, replay=replace(healthy.replay, watches=watches)))
    assert "second watched nothing at all." in Page(half).text
    assert 'class="verdict unknown"' in half
    assert 'class="verdict"' in recording_report(healthy)


def test_an_empty_recording_is_reported_too(arm_profile: Profile, tmp_path: Path) -> None:
    assert "no message" in Page(recording_report(run_of(arm_profile, tmp_path, iter([])))).text


def test_names_from_outside_are_text_and_nothing_else(faulty: Run, tmp_path: Path) -> None:
    hostile_events = tuple(
        replace(event, message=HOSTILE, unit=HOSTILE, **({"channel": HOSTILE} if event.channel == "motor" else {}))
        for event in faulty.replay.events
    )
    traces = tuple(
        replace(
            trace,
            layout=replace(
                trace.layout,
                faults=tuple(HOSTILE if name == "motor" else name for name in trace.layout.faults),
                inputs=tuple(HOSTILE for _ in trace.layout.inputs),
                outputs=tuple(HOSTILE for _ in trace.layout.outputs),
            ),
        )
        for trace in faulty.replay.traces
    )
    replay = replace(faulty.replay, events=hostile_events, traces=traces)
    profile = replace(faulty.profile, name=HOSTILE, vehicle=HOSTILE)
    html = recording_report(replace(faulty, vehicle=HOSTILE, verdict=HOSTILE, replay=replay, profile=profile))
    page = Page(html)
    assert "img" not in page.tags
    assert page.handlers == page.loads == []
    assert not any("alert" in script for script in scripts(html))
    assert "<script>alert(1)</script>" in page.text
    assert "\x1b" not in html


def test_what_thresholds_rest_on_is_told_where_the_fit_says_it(healthy: Run) -> None:
    rules = [rule for observer in healthy.profile.observers for rule in observer.alarms]
    said = {
        "threshold": rules[0].threshold,
        "level": 0.0123,
        "level_low": 0.011,
        "level_high": 2 * rules[0].threshold,
        "healthy_hours": 0.5,
    }
    fit = {"observers": {rules[0].observer: {"alarms": {rules[0].channel: said}}}}
    (healthy.folder / "fit.json").write_text(json.dumps(fit))
    text = Page(recording_report(healthy)).text
    assert "30 min of healthy flight: too little to promise that rate" in text
    said["threshold"] = 3 * rules[0].threshold
    (healthy.folder / "fit.json").write_text(json.dumps(fit))
    assert "30 min" not in Page(recording_report(healthy)).text
    (healthy.folder / "fit.json").write_text("{broken")
    assert "not calibrated, or edited since" in Page(recording_report(healthy)).text


def test_the_command_writes_a_report(arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, log, out = tmp_path / "arm", tmp_path / "arm.mcap", tmp_path / "arm.html"
    folder.mkdir()
    for name, content in arm_profile.files.items():
        (folder / name).write_bytes(content)
    with MessageLogWriter(log) as writer:
        for message in arm_messages(simulate_arm(SCENARIOS["healthy"], 12.4, 100.0, "zero"), START_NS):
            writer.write(message)
    assert fauio.main(["replay", str(folder), str(log), "--report", str(out)]) == 0
    assert "no alarm in 5 s of watched flight" in capsys.readouterr().out
    text = Page(out.read_text()).text
    assert "No alarm in 5 s of watched flight." in text
    assert f"{log.stat().st_size:,} bytes" in text
    assert fauio.main(["replay", str(folder), str(log), str(log), "--report", str(out)]) == 2
