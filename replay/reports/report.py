"""The report of a run as one HTML file: what was found, how sure, what could not be checked, and what it rests on."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from adapters.logs.damage import Damage
from adapters.output_file import write_file
from monitor.bus.alarm_text import utc
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR
from monitor.profile import Profile
from monitor.views.panels import RunView, TrueSizes
from replay.player import Replay
from replay.reports.findings import Calibration, Finding, WatchedChannel, effects, findings, watched_channels
from replay.reports.plot import plot_svg
from replay.reports.recording_facts import RecordingFacts, StreamFacts
from replay.reports.report_html import Html, element, facts, joined_html, page, section, table
from replay.reports.unchecked import unchecked

_WATCHED_HEADS = (
    "channel",
    "unit",
    "largest",
    "threshold",
    "share",
    "alarms",
    "healthy level",
    "at most",
    "known from",
    "sees",
)
_LIBRARIES = ("numpy", "scipy", "pymavlink", "mcap", "matplotlib")


@dataclass(frozen=True, slots=True)
class Run:
    """A run to report on."""

    profile: Profile
    folder: Path  # where it stands
    log: Path
    vehicle: str
    verdict: str  # what was found, in a sentence
    replay: Replay  # what came out, with traces
    recording: RecordingFacts  # what went in
    damage: tuple[Damage, ...] = ()  # what of the recording could not be read
    truth: TrueSizes = field(default_factory=dict)  # what is known to have been injected, by channel


def write_report(path: str | os.PathLike[str], run: Run) -> None:
    """Write the report of a run: HTML with its pictures inside, light and dark, that loads and runs nothing."""
    write_file(path, recording_report(run))


def recording_report(run: Run) -> str:
    """Return the report of a run as an HTML page."""
    replay = run.replay
    results = findings(run.profile, replay.events, replay.traces)
    watched_s = {name: watch.watched_s for name, watch in replay.watches.items()}
    watched = watched_channels(run.profile, run.folder, replay.traces, watched_s, results)
    return page(
        f"{run.vehicle}: {run.log.name}",
        element("h1", f"{run.vehicle}: {run.log.name}"),
        _header(run, results),
        section("What was found", *_found(run, results)),
        section("How sure", *_how_sure(run, results, watched)),
        section("What could not be checked, and why", _unchecked(run, results)),
        section("Plots", *_plots(run)),
        section("The recording", *_recording(run)),
        section("How this was made", _made(run)),
    )


def _header(run: Run, results: Sequence[Finding]) -> Html:
    worst = {one.alarm.severity for one in results}
    mark = next((severity for severity in ("critical", "warning") if severity in worst), "")
    if not mark and _blind(run.replay):
        mark = "unknown"
    when = utc(run.recording.first_ns) if run.recording.first_ns is not None else "no message"
    return joined_html(
        [
            element("div", _sentence(run.verdict), class_=f"verdict {mark}".strip()),
            element("p", f"{when} · {_span(run.recording.duration_s)} · {run.profile.vehicle}", class_="note"),
        ]
    )


def _found(run: Run, results: Sequence[Finding]) -> Iterator[Html]:
    if not results:
        yield element("p", _nothing_found(run))
    # the vehicle's time of the first sample, from which the plots count
    zero_ns = min((int(one.vehicle_ns[0]) for one in run.replay.traces if len(one.vehicle_ns)), default=None)
    for one in results:
        yield element(
            "article",
            element("h3", f"{one.alarm.observer} / {one.alarm.channel}: {one.largest.message}"),
            facts(_of_finding(one, zero_ns)),
            class_=one.alarm.severity,
        )


def _nothing_found(run: Run) -> str:
    if not run.replay.evidence:
        return "Nothing: no observer watched for a single sample. This says nothing about the vehicle."
    blind = "".join(f" {name} watched nothing at all." for name in _blind(run.replay))
    return f"No alarm was raised.{blind} That covers the channels below, from their thresholds on, while watched."


def _blind(replay: Replay) -> list[str]:
    """Return the observers that watched nothing: without them, no alarm is no good news."""
    return [name for name, watch in replay.watches.items() if not watch.evidence]


def _of_finding(one: Finding, zero_ns: int | None) -> Iterator[tuple[str, object]]:
    alarm, unit, threshold = one.alarm, one.largest.unit, one.alarm.history[0].threshold
    yield "when", _moment(alarm.start_ns, alarm.start_vehicle_ns, zero_ns)
    if alarm.end_ns is None or alarm.end_vehicle_ns is None:
        yield "how long", "until the end of the recording"
    else:
        lasted_s = (alarm.end_vehicle_ns - alarm.start_vehicle_ns) / 1e9
        yield "how long", f"{_span(lasted_s)}, cleared {_moment(alarm.end_ns, alarm.end_vehicle_ns, zero_ns)}"
    if one.typical is not None:
        if one.deviation is None:
            yield "how large", f"{_size(one.typical, unit)} (median while it was active)"
        else:
            size = f"{one.typical:.3g} ± {one.deviation:.2g} {unit}".rstrip()
            yield "how large", f"{size} (median while it was active ± one standard deviation)"
    if one.peak is not None:
        share = f", {100 * one.largest.relative:+.0f} % of the command" if one.largest.relative is not None else ""
        yield "peak", f"{_size(one.peak, unit)}{share}"
    yield "severity", alarm.severity
    if one.effect is not None:
        yield "how sure", f"said only where it is {_certain(one.effect)}"
    elif threshold and one.peak is not None:
        times = abs(one.peak) / threshold
        yield "threshold it passed", f"{_size(threshold, unit)}; the peak is {times:.3g} times as large"
    if one.rival is not None:
        name, share_of = one.rival
        yield (
            "other explanations",
            f"{name} came closest: it was held responsible for {100 * share_of:.0f} % of its own threshold at most"
            if share_of > 0
            else "no other channel of this observer was held responsible for anything meanwhile",
        )


def _how_sure(run: Run, results: Sequence[Finding], watched: Sequence[WatchedChannel]) -> Iterator[Html]:
    yield element(
        "p",
        "The largest estimate while alarms could be raised, against the threshold. Calibrated thresholds were set on "
        f"healthy flights for {FALSE_ALARMS_PER_HOUR:g} false alarms per hour and observer, shared by its channels: at "
        "that rate healthy flight exceeds the healthy level. The level is known only as well as those flights allow; "
        "where its upper confidence limit is bold it is above the threshold, and false alarms may come more often.",
    )
    for observer in dict.fromkeys(one.rule.observer for one in watched):
        own = [one for one in watched if one.rule.observer == observer]
        watched_s = own[0].watched_s
        yield element("h3", f"{observer}, " + (f"watched for {_span(watched_s)}" if watched_s else "never watched"))
        yield table(_WATCHED_HEADS, map(_of_channel, own), numbers=range(2, 9))
    others = sorted({one.alarm.observer for one in results} - {observer.name for observer in run.profile.observers})
    if others:
        yield element("p", f"Alarms of {', '.join(others)} come from fixed rules, not from calibration.", class_="note")


def _of_channel(one: WatchedChannel) -> tuple[object, ...]:
    calibration = one.calibration or Calibration(None, None, None, None)
    high = calibration.high
    limit: object = "" if high is None else f"{high:.2g}"
    return (
        one.rule.channel,
        one.rule.unit,
        "" if one.peak is None else f"{one.peak:.3g}",
        f"{one.rule.threshold:.3g}" if one.effect is None else "",
        "" if one.share is None else f"{100 * one.share:.0f} %",
        one.alarms or "",
        "" if calibration.level is None else f"{calibration.level:.2g}",
        element("strong", limit) if high is not None and high > one.rule.threshold else limit,
        "" if calibration.hours is None else f"{60 * calibration.hours:.0f} min",
        one.rule.sees or _why_no_words(one),
    )


def _why_no_words(one: WatchedChannel) -> str:
    if one.effect is not None:
        return _certain(one.effect)
    if one.calibration is None:
        return "threshold not calibrated, or edited since"
    return ""


def _certain(effect: EffectivenessRule) -> str:
    return (
        f"certain: {effect.certainty:.2g} standard errors from healthy, and at least "
        f"{100 * effect.least_loss:.0f} % of the effect lost or {100 * effect.least_offset:.0f} % of full "
        "deflection off"
    )


def _unchecked(run: Run, results: Sequence[Finding]) -> Html:
    return table(("not checked", "why"), unchecked(run.profile, run.replay, run.recording, results, run.damage))


def _plots(run: Run) -> Iterator[Html]:
    replay = run.replay
    shown = RunView(replay.traces, replay.events, replay.thresholds, run.truth, effects(run.profile))
    drawn = [trace for trace in replay.traces if len(trace.vehicle_ns)]
    for trace in drawn:
        picture = plot_svg(shown, trace)
        yield element(
            "figure",
            element("h3", trace.layout.observer),
            element(
                "div",
                Html(picture),
                class_="picture",
                role="img",
                aria_label=f"estimates, residuals and inputs: {trace.layout.observer}",
            ),
        )
    if not drawn:
        yield element("p", "No observer had a sample: there is nothing to draw.")


def _recording(run: Run) -> Iterator[Html]:
    recording = run.recording
    yield facts(
        [
            ("file", element("code", str(run.log))),
            ("size", _bytes(run.log)),
            ("from", "" if recording.first_ns is None else utc(recording.first_ns)),
            ("to", "" if recording.last_ns is None else utc(recording.last_ns)),
            ("duration", _span(recording.duration_s)),
            ("messages", f"{recording.messages:,} that the profile reads"),
        ]
    )
    yield table(
        ("observer", "samples", "per second", "watched", "coasted", "in gaps", "late", "invalid", "untimed"),
        [
            (
                name,
                f"{watch.samples:,}",
                f"{watch.rate_hz:g}",
                _span(watch.watched_s),
                f"{100 * watch.coasted / watch.samples:.2f} %" if watch.samples else "",
                f"{watch.sampling.skipped:,}",
                f"{watch.sampling.late:,}",
                f"{watch.sampling.invalid:,}",
                f"{watch.sampling.untimed:,}",
            )
            for name, watch in run.replay.watches.items()
        ],
        numbers=range(1, 9),
    )
    yield table(
        ("message", "from", "count", "per second", "gaps", "longest gap"),
        [_of_stream(stream) for stream in recording.streams],
        numbers=range(2, 6),
    )
    yield element("p", "A gap is longer than half a second and than ten usual periods.", class_="note")


def _of_stream(stream: StreamFacts) -> tuple[object, ...]:
    longest = max((gap.seconds for gap in stream.gaps), default=0.0)
    has_ids = stream.source.is_telemetry and stream.source.has_ids
    sender = f"system {stream.system}, component {stream.component}" if has_ids else stream.source.name
    return (
        stream.name,
        sender,
        f"{stream.count:,}",
        f"{stream.rate_hz:.3g}" if stream.rate_hz else "",
        len(stream.gaps) or "",
        f"{longest:.1f} s" if longest else "",
    )


def _made(run: Run) -> Html:
    gate = run.profile.gate
    rules = [
        *["armed"] * gate.require_armed,
        *["in the air"] * gate.require_airborne,
        f"for {gate.settle_s:g} s and more",
    ]
    versions = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return facts(
        [
            ("fauio", version("fauio")),
            ("runs on", f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"),
            ("libraries", versions),
            ("profile", joined_html([run.profile.name, ", ", element("code", str(run.folder))])),
            ("profile's hash", element("code", run.profile.digest)),
            ("counts as evidence", ", ".join(rules)),
        ]
    )


def _moment(unix_ns: int, vehicle_ns: int, zero_ns: int | None) -> str:
    shown = "" if zero_ns is None else f"{(vehicle_ns - zero_ns) / 1e9:.1f} s in the plots, "
    return f"{utc(unix_ns)} ({shown}vehicle's clock {vehicle_ns / 1e9:.1f} s)"


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:] + "."


def _size(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".rstrip()


def _span(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _bytes(path: Path) -> str:
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return f"{sum(file.stat().st_size for file in files):,} bytes" + (
        "" if path.is_file() else f" in {len(files)} files"
    )
