"""The report of a run as one HTML file: its findings, their certainty, what could not be checked, and their basis."""

import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.logs.damage import Damage
from monitor.bus.alarm_text import utc
from monitor.display import doubt_text, fault_text
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.fitting.progress import recording_bytes
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR
from monitor.profile import Profile
from monitor.trace import AlarmSpan
from monitor.views.panels import RunView, TrueSizes
from replay.player import Replay
from replay.reports.charts import BINS, Chart, Charts, origin_ns, signal_chart
from replay.reports.findings import Finding, WatchedChannel, effects, findings, watched_channels
from replay.reports.recording_facts import RecordingFacts, StreamFacts
from replay.reports.report_html import Html, element, facts, folded, joined_html, page, section, table
from replay.reports.unchecked import unchecked
from replay.reports.verdict import run_sentence, said_about, span_text
from replay.review.facts.log_facts import LogFacts, LogSignal

_MAP_PX = 640
"""Width and height of the map in its own units; it is drawn as wide as the page. Chosen: a unit is about a pixel."""
_MARGIN_PX = 24
"""Margin of the map, in its units. Chosen by eye."""
_LEAST_M = 20.0
"""Smallest side of the map. Chosen: a hover drawn larger would show the receiver's noise as a flight path."""
_MOST_LINES = 200
"""Lines of text from a log. Chosen: some pages; for a log with more lines other tools are better."""
_BARS = (1.0, 2.0, 5.0)
"""Lengths of the scale bar, times powers of ten: round ones."""


def flight_parts(facts: LogFacts, alarms: Sequence[AlarmSpan], charts: Charts, zero_s: float) -> Iterator[Html]:
    """Yield a map of the flight path, a chart of height with modes, and a table of the texts.

    ``zero_s`` is the zero of the charts' time, in seconds since the log's begin.
    """
    spans = [
        (
            (alarm.start_ns - facts.start_ns) / 1e9,
            facts.duration_s if alarm.end_ns is None else (alarm.end_ns - facts.start_ns) / 1e9,
            alarm.severity,
        )
        for alarm in alarms
    ]
    way = facts.signals.get("position")
    if way is not None and len(way.time_s) > 1:
        yield _map(way, spans)
    height = facts.signals.get("height_estimate") or facts.signals.get("height")
    if height is not None and len(height.time_s) > 1:
        yield charts.add(_height_chart(height, facts, spans, zero_s))
    said = [statement for statement in facts.statements if statement.kind in ("mode", "text", "failsafe", "arming")]
    if said:
        rows = [
            (utc(facts.start_ns + round(1e9 * statement.time_s))[11:23], statement.kind, statement.text)
            for statement in said[:_MOST_LINES]
        ]
        more = len(said) - len(rows)
        words = f"What the log says, {len(said)} lines" + (f", the first {len(rows)}" if more else "")
        yield folded(words, table(("time", "kind", "text"), rows))


def _height_chart(
    height: LogSignal, facts: LogFacts, spans: Sequence[tuple[float, float, str]], zero_s: float
) -> Chart:
    chart = signal_chart("height, and flight modes", height.time_s - zero_s, height.values[:, :1], ["height"], "m")
    chart.content["spans"] = [
        {"from": round(start - zero_s, 2), "to": round(end - zero_s, 2), "severity": severity}
        for start, end, severity in spans
    ]
    modes = [statement for statement in facts.statements if statement.kind == "mode"]
    chart.content["marks"] = [[round(mode.time_s - zero_s, 2), mode.text] for mode in modes[:_MOST_LINES]]
    return chart


def _map(way: LogSignal, spans: Sequence[tuple[float, float, str]]) -> Html:
    """Return the flight path seen from above, north up, with its parts during alarms."""
    places = way.values[:, :2]
    known = np.isfinite(places).all(axis=1)
    times_s, places = way.time_s[known], places[known]
    if len(places) < 2:
        return Html("")
    middle = (places.max(axis=0) + places.min(axis=0)) / 2.0
    size_m = max(float(np.ptp(places, axis=0).max()), _LEAST_M)
    scale = (_MAP_PX - 2 * _MARGIN_PX) / size_m
    x = _MAP_PX / 2 + scale * (places[:, 1] - middle[1])
    y = _MAP_PX / 2 - scale * (places[:, 0] - middle[0])
    lines = [_line(x, y, "way")]
    for start_s, end_s, severity in spans:
        first, last = np.searchsorted(times_s, (start_s, end_s))
        lines.append(_line(x[first : last + 1], y[first : last + 1], f"way {severity}"))
    bar_m = max(base * 10.0**power for power in range(-1, 7) for base in _BARS if base * 10.0**power <= size_m / 3.0)
    bar = f'<path class="bar" d="M{_MARGIN_PX} {_MAP_PX - 12}h{bar_m * scale:.1f}"/>'
    words = f'<text x="{_MARGIN_PX}" y="{_MAP_PX - 18}">{bar_m:g} m, north is up</text>'
    begin = f'<circle cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="5"/>'
    drawn = joined_html([*lines, Html(begin), Html(bar), Html(words)])
    svg = element("svg", drawn, viewBox=f"0 0 {_MAP_PX} {_MAP_PX}", role="img", aria_label="the track from above")
    return element("figure", element("figcaption", "the track, from the circle on; parts with alarms are thick"), svg)


def _line(x: NDArray[np.float64], y: NDArray[np.float64], name: str) -> Html:
    step = max(1, len(x) // (2 * BINS))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[::step], y[::step], strict=True))
    return Html(f'<polyline class="{name}" points="{points}"/>')


_WATCHED_HEADS = ("channel", "largest", "alarm from", "alarms", "what it sees", "threshold rests on")
_MOST_SAID = 5
"""Texts of the autopilot for one alarm. Chosen: a failsafe comes with two or three texts; repeated ones add nothing."""
_CHECKS: Mapping[str, str] = {
    r"motor\d+": "that motor's propeller (chipped, loose, wrong way up), its ESC and connectors, then its bearings; a "
    "payload off the middle, or an arm bent, looks alike on every flight",
    r"esc\d+": "that ESC: its desynchronisation and temperature messages, connectors, firmware settings",
    r"prop\d+": "that propeller: chipped, loose, of another size, or the wrong way up",
    r"gps_(north|east|down)|motion_(north|east)": "whether the position by GPS is right; satellites and noise of the "
    "receiver; jammers or spoofers near by; buildings that reflect",
    r"gps_velocity_\w+": "the receiver: satellites, noise, reflections; a spoofer that moves slowly shows here first",
    r"baro": "the barometer's hole (wind, rotor wash, light, water), and whether the temperature changed fast",
    r"compass": "currents and metal near the compass, its calibration, whether it is turned in its mount",
    r"gyro_\w+": "that gyro: its temperature, its calibration, vibration; compare the vehicle's other gyros",
    r"accel_\w+": "that accelerometer: clipping, vibration, its mount; compare the vehicle's other accelerometers",
    r"attitude_\w+": "the autopilot's attitude estimate: its innovations, resets, and the sensors behind it",
    r"aileron|elevator|rudder|flap": "that surface's servo, horn, rod and hinge, and that nothing blocks it",
    r"throttle": "the drive: propeller, ESC, battery, and in a ground vehicle the wheels' grip",
    r"steering": "the steering servo and linkage, wheels and tyres",
    r"airspeed": "the pitot tube: blocked, iced, or its hose leaking",
    r"battery": "the battery's cells, age and temperature, and its connectors",
    r"prop\d+_imbalance": "that propeller's balance: chips, cracks, dirt, a blade that sits askew; the motor's shaft",
    r"vibration|clipping": "propellers for balance, mounts of the autopilot, loose parts",
    r"impostor|signing|heartbeat": "who else sends on this link: a second vehicle of the same id, a ground station, "
    "an attacker; sign the link",
    r"command": "who sent it: a second ground station, a companion computer, an attacker; sign the link",
    r"telemetry": "the radio, its aerials and range, and whether the autopilot rebooted",
    r"unexplained": "what the other charts show at that time: a gust, a collision, two faults at once, or a vehicle "
    "changed since its profile was fitted",
}
"""First things for a person to check after an alarm of a channel."""
_LIBRARIES = ("numpy", "scipy", "pymavlink", "mcap", "matplotlib")


@dataclass(frozen=True, slots=True)
class Run:
    """A run to report on."""

    profile: Profile
    folder: Path  # the profile's folder
    log: Path
    vehicle: str
    verdict: str  # the findings, in a sentence
    replay: Replay  # results, with traces
    recording: RecordingFacts  # facts about the replayed recording
    damage: tuple[Damage, ...] = ()  # unreadable parts of the recording
    truth: TrueSizes = field(default_factory=dict)  # true sizes of the injected faults, by channel
    facts: LogFacts | None = None  # statements of the log about the flight; None if it is not an autopilot's log


def recording_report(run: Run) -> str:
    """Return the report of a run as an HTML page: the verdict, each alarm, the flight, then tables.

    Its charts react to the pointer; it loads no other file.
    """
    replay = run.replay
    results = findings(run.profile, replay.events, replay.traces)
    watched_s = {name: watch.watched_s for name, watch in replay.watches.items()}
    watched = watched_channels(run.profile, run.folder, replay.traces, watched_s, results)
    view = RunView(replay.traces, replay.events, replay.thresholds, run.truth, effects(run.profile))
    left = unchecked(run.profile, replay, run.recording, results, run.damage)
    charts = Charts(view)
    return page(
        f"{run.vehicle}: {run.log.name}",
        element("h1", f"{run.vehicle}: {run.log.name}"),
        _header(run, results),
        section("What was found", *_found(run, results, watched, charts)),
        *_flight(run, results, charts),
        *_conditions(run),
        section("What was watched", *_watched(run, results, watched)),
        section("What could not be checked, and why", table(("not checked", "why"), left)),
        folded("All channels, residuals and inputs", *_all_charts(run, charts)),
        folded("The recording", *_recording(run)),
        folded("How this was made", _made(run)),
        charts=charts.to_json(),
    )


def _header(run: Run, results: Sequence[Finding]) -> Html:
    worst = {result.alarm.severity for result in results}
    mark = next((severity for severity in ("critical", "warning") if severity in worst), "")
    if not mark and _blind(run.replay):
        mark = "unknown"
    when = utc(run.recording.first_ns) if run.recording.first_ns is not None else "no message"
    words = run_sentence(results, run.facts) if results else run.verdict
    return joined_html(
        [
            element("div", f"{words[:1].upper()}{words[1:]}.", class_=f"verdict {mark}".strip()),
            element("p", f"{when} · {span_text(run.recording.duration_s)} · {run.profile.vehicle}", class_="note"),
        ]
    )


def _found(run: Run, results: Sequence[Finding], watched: Sequence[WatchedChannel], charts: Charts) -> Iterator[Html]:
    if not results:
        yield element("p", _nothing_found(run, watched))
    traces = {trace.layout.observer: trace for trace in run.replay.traces if len(trace.vehicle_ns)}
    for result in results:
        trace = traces.get(result.alarm.observer)
        shown = trace is not None and result.alarm.channel in trace.layout.faults
        yield element(
            "article",
            element("h3", f"{result.alarm.observer} / {result.alarm.channel}: {result.message}"),
            facts(_of_finding(run, result)),
            charts.add_fault(result.alarm.observer, result.alarm.channel) if shown else "",
            class_=result.alarm.severity,
        )


def _nothing_found(run: Run, watched: Sequence[WatchedChannel]) -> str:
    if not run.replay.evidence:
        return "Nothing: no observer watched for a single sample. This says nothing about the vehicle."
    blind = "".join(f" {name} watched nothing at all." for name in _blind(run.replay))
    least: dict[str, WatchedChannel] = {}
    for candidate in watched:
        known = least.get(candidate.rule.channel, candidate).rule
        if (
            candidate.watched_s
            and candidate.effect is None
            and "times" not in candidate.rule.unit
            and candidate.rule.threshold <= known.threshold
        ):
            least[candidate.rule.channel] = candidate
    from_size: dict[str, list[str]] = {}
    for channel, candidate in least.items():
        from_size.setdefault(candidate.size_text(candidate.rule.threshold), []).append(channel)
    seen = "; ".join(f"{', '.join(channels)} from {size}" for size, channels in from_size.items())
    return (
        f"No alarm was raised.{blind} That covers the channels below, from their thresholds on, while watched."
        f"{seen and f' It would have shown: {seen}.'}"
    )


def _blind(replay: Replay) -> list[str]:
    """Return the observers that watched nothing: for them, the lack of an alarm is no good news."""
    return [name for name, watch in replay.watches.items() if not watch.evidence]


def _of_finding(run: Run, finding: Finding) -> Iterator[tuple[str, object]]:
    alarm = finding.alarm
    yield "when", _moment(run, alarm.start_ns, alarm.start_vehicle_ns)
    if alarm.end_ns is None or alarm.end_vehicle_ns is None:
        yield "how long", "until the end of the recording"
    else:
        lasted_s = (alarm.end_vehicle_ns - alarm.start_vehicle_ns) / 1e9
        yield "how long", f"{span_text(lasted_s)}, cleared {_moment(run, alarm.end_ns, alarm.end_vehicle_ns)}"
    if (size := _size_of(finding)) is not None:
        yield "how large", size
    yield "severity", alarm.severity
    if finding.effect is not None:
        yield "how sure", f"said only where it is {_certain(finding.effect)}"
    if finding.rival is not None and finding.rival[1] >= 1.0:
        yield "not told apart from", f"{finding.rival[0]}, whose estimate passed its own threshold meanwhile"
    if advice := next((words for pattern, words in _CHECKS.items() if re.fullmatch(pattern, alarm.channel)), ""):
        yield "what to check", advice
    if run.facts is not None and (said := said_about(finding, run.facts)):
        yield "the autopilot said", "; ".join(dict.fromkeys(text.text for text in said[:_MOST_SAID]))


def _size_of(finding: Finding) -> str | None:
    """Return an alarm's size as the whole page shows it, with its uncertainty if that is known."""
    if finding.size is None:
        return finding.largest.display or None
    said = fault_text(finding.alarm.channel, finding.size, finding.relative, finding.largest.unit)
    if finding.deviation and finding.size:
        share = None if finding.relative is None else finding.relative / finding.size
        said += f" ± {doubt_text(2.0 * finding.deviation, finding.largest.unit, share)} (two standard deviations)"
    return f"{said}{', at the end of its growth' if finding.grew else ''}"


def _flight(run: Run, results: Sequence[Finding], charts: Charts) -> Iterator[Html]:
    """Yield the flight according to the log: the path over ground, height, modes and texts."""
    if run.facts is None:
        return
    first = min(
        (trace for trace in run.replay.traces if len(trace.unix_ns)),
        key=lambda trace: int(trace.vehicle_ns[0]),
        default=None,
    )
    zero_s = 0.0 if first is None else (int(first.unix_ns[0]) - run.facts.start_ns) / 1e9
    parts = [*flight_parts(run.facts, [result.alarm for result in results], charts, zero_s)]
    if parts:
        yield section("The flight", *parts)


def _all_charts(run: Run, charts: Charts) -> Iterator[Html]:
    drawn = [trace for trace in run.replay.traces if len(trace.vehicle_ns)]
    for trace in drawn:
        yield element("h3", trace.layout.observer)
        yield from charts.add_observer(trace.layout.observer)
    if not drawn:
        yield element("p", "No observer had a sample: there is nothing to draw.")


def _watched(run: Run, results: Sequence[Finding], watched: Sequence[WatchedChannel]) -> Iterator[Html]:
    yield element(
        "p",
        "The largest estimate while alarms could be raised, and the size that raises one. Thresholds were set on "
        f"healthy flights for {FALSE_ALARMS_PER_HOUR:g} false alarms per hour and observer, shared by its channels.",
    )
    for observer in dict.fromkeys(entry.rule.observer for entry in watched):
        own = [entry for entry in watched if entry.rule.observer == observer]
        watched_s = own[0].watched_s
        yield element("h3", f"{observer}, " + (f"watched for {span_text(watched_s)}" if watched_s else "never watched"))
        yield table(_WATCHED_HEADS, map(_of_channel, own), numbers=range(1, 4))
    others = sorted(
        {result.alarm.observer for result in results} - {observer.name for observer in run.profile.observers}
    )
    if others:
        yield element("p", f"Alarms of {', '.join(others)} come from fixed rules, not from calibration.", class_="note")


def _of_channel(watched: WatchedChannel) -> tuple[object, ...]:
    return (
        watched.rule.channel,
        "" if watched.peak is None else watched.size_text(watched.peak),
        watched.size_text(watched.rule.threshold) if watched.effect is None else "",
        watched.alarms or "",
        watched.rule.sees or ("" if watched.effect is None else _certain(watched.effect)),
        _rests_on(watched),
    )


def _rests_on(watched: WatchedChannel) -> str:
    known = watched.calibration
    if known is None:
        return "" if watched.effect is not None else "not calibrated, or edited since"
    if known.hours is None:
        return ""
    text = f"{60 * known.hours:.0f} min of healthy flight"
    if known.high is not None and known.high > watched.rule.threshold:
        return f"{text}: too little to promise that rate"
    return text


def _certain(effect: EffectivenessRule) -> str:
    return (
        f"certain: {effect.certainty:.2g} standard errors from healthy, and at least "
        f"{100 * effect.least_loss:.0f} % of the effect lost or {100 * effect.least_offset:.0f} % of full "
        "deflection off"
    )


def _conditions(run: Run) -> Iterator[Html]:
    if run.replay.conditions:
        rows = [(utc(condition.since_ns)[11:19], condition.text) for condition in run.replay.conditions]
        yield section("What is no fault", table(("from", "what"), rows))


def _recording(run: Run) -> Iterator[Html]:
    recording = run.recording
    yield facts(
        [
            ("file", element("code", str(run.log))),
            ("size", f"{recording_bytes(run.log):,} bytes"),
            ("from", "" if recording.first_ns is None else utc(recording.first_ns)),
            ("to", "" if recording.last_ns is None else utc(recording.last_ns)),
            ("duration", span_text(recording.duration_s)),
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
                span_text(watch.watched_s),
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


def _moment(run: Run, unix_ns: int, vehicle_ns: int) -> str:
    zero_ns = origin_ns(run.replay.traces)
    shown = f"{(vehicle_ns - zero_ns) / 1e9:.1f} s in the charts, " if zero_ns else ""
    return f"{utc(unix_ns)} ({shown}vehicle's clock {vehicle_ns / 1e9:.1f} s)"
