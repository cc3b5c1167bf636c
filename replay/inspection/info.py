"""The content of one of fauio's files (a recording, a profile, a model or gains), as one JSON object."""

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

from adapters.errors import InfeasibleError, ModelError, TelemetryError
from adapters.toml_tables import read_toml
from gains.analysis.check import check_plant, check_text
from gains.identification.free_model import read_free_model
from gains.plants.model_file import BUILTIN_MODELS, load_model
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains, read_gains
from gains.synthesis.peak import largest_bounds
from monitor.display import size_text
from monitor.profile import PROFILE_FILE, ObserverProfile, read_profile
from replay.inspection.log_info import log_info
from replay.player import interests


def info(path: Path) -> dict[str, Any]:
    """Return the content of a file or folder; its ``kind`` tells which kind of file it is.

    Raises
    ------
    TelemetryError, ProfileError, ModelError
        It is none of these, or cannot be read.
    """
    if path.name == PROFILE_FILE and path.is_file():
        return profile_info(path.parent)
    if (path / PROFILE_FILE).is_file():
        return profile_info(path)
    if path.suffix == ".toml" or (str(path) in BUILTIN_MODELS and not path.exists()):
        return model_info(path)
    if not path.exists():
        raise TelemetryError(f"{path}: no such file; give a recording, a profile, a model or gains")
    if path.suffix == ".json":
        return gains_info(path)
    return log_info(path)


def profile_info(folder: Path) -> dict[str, Any]:
    """Return what a profile watches, its certified bounds, and the sizes that raise alarms."""
    profile = read_profile(folder)
    said = tomllib.loads(profile.files[PROFILE_FILE].decode())["observers"]
    return {
        "file": str(folder),
        "kind": "profile",
        "name": profile.name,
        "vehicle": profile.vehicle,
        "system": profile.system,
        "stale_s": profile.stale_s,
        "phase": {
            "require_armed": profile.gate.require_armed,
            "require_airborne": profile.gate.require_airborne,
            "settle_s": profile.gate.settle_s,
        },
        "messages": sorted(
            interests(profile) & {name for observer in profile.observers for name in _messages(observer)}
        ),
        "observers": {
            observer.name: _observer(observer, said[observer.name]["alarms"]) for observer in profile.observers
        },
        "digest": profile.digest,
    }


def _messages(observer: ObserverProfile) -> set[str]:
    return {channel.message for channel in observer.source.channels}


def _observer(observer: ObserverProfile, said: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    gains = observer.gains
    at_most = largest_bounds(one.report for one in gains)
    return {
        "rate_hz": observer.rate_hz,
        "hypotheses": len(gains),
        **_names(gains[0]),
        "faults": [fault.name for fault in observer.faults],
        "messages": sorted(_messages(observer)),
        **_bounds(gains),
        "alarms": {
            rule.channel: {
                "kind": rule.kind,
                "threshold": rule.threshold,
                "usual_command": observer.usual_commands.get(rule.channel),
                "critical": rule.critical,
                "at_most": at_most.get(rule.channel),
                "unit": rule.unit,
                "raise_s": rule.raise_s,
                "sees": said[rule.channel].get("sees"),
            }
            for rule in observer.alarms
        },
    }


def _names(of: Gains | Plant) -> dict[str, list[str]]:
    return {"inputs": list(of.inputs), "outputs": list(of.outputs), "states": list(of.states)}


def _bounds(gains: Sequence[Gains]) -> dict[str, Any]:
    """Return the worst certified bound, the worst norm, and whether every certificate holds."""
    certificates = [gain.report.get("certificate") for gain in gains]
    return {
        "sqrt_mu": _worst(gains, "sqrt_mu"),
        "norm": _worst(gains, "norm"),
        "certified": all(
            isinstance(certificate, Mapping) and certificate.get("holds") is True for certificate in certificates
        ),
    }


def _worst(gains: Sequence[Gains], key: str) -> float | None:
    bounds = [gain.report.get(key) for gain in gains]
    known = [value for value in bounds if isinstance(value, int | float)]
    return max(known) if len(known) == len(bounds) else None


def gains_info(path: Path) -> dict[str, Any]:
    """Return the faults that gains estimate, their model, and their certified performance."""
    gains = read_gains(path)
    return {
        "file": str(path),
        "kind": "gains",
        "model": gains.model,
        "model_hash": gains.model_hash,
        "method": gains.method,
        "domain": gains.domain,
        "rate_hz": gains.rate_hz,
        **_names(gains),
        "faults": [
            {"name": name, "kind": kind, "unit": unit}
            for name, kind, unit in zip(gains.faults, gains.fault_kinds, gains.fault_units, strict=True)
        ],
        "nonlinearities": len(gains.nonlinearities),
        "matrix": list(gains.step_matrix.shape),
        **_bounds([gains]),
    }


def model_info(path: Path) -> dict[str, Any]:
    """Return a model's names and sizes, and whether its faults can be estimated."""
    free = None
    if str(path) not in BUILTIN_MODELS and read_toml(path, ModelError).root.has("parameters"):
        free = read_free_model(path)
    plant = load_model(path) if free is None else free.example
    estimable, verdict = _checked(plant)
    return {
        "file": str(path),
        "kind": "model",
        "name": plant.name,
        "description": plant.description,
        "domain": plant.domain,
        "rate_hz": plant.rate_hz,
        **_names(plant),
        "faults": [{"name": fault.name, "kind": fault.kind, "unit": fault.unit} for fault in plant.faults],
        "disturbances": [signal.name for signal in plant.disturbances],
        "noises": [signal.name for signal in plant.noises],
        "nonlinearities": [nonlinearity.expression for nonlinearity in plant.nonlinearities],
        "parameters": None if free is None else [parameter.name for parameter in free.parameters],
        "estimable": estimable,
        "check": verdict,
    }


def _checked(plant: Plant) -> tuple[bool | None, str]:
    """Return whether all faults can be estimated together, and the findings in one line."""
    try:
        check = check_plant(plant)
    except (ModelError, InfeasibleError) as error:
        return None, str(error)
    return check.estimable, check_text(check).splitlines()[0]


_FORMATS = {
    "tlog": "MAVLink telemetry log",
    "mcap": "MCAP",
    "ulog": "PX4 log",
    "dataflash": "ArduPilot log",
}
_MOST_ALARMS = 20
"""Alarms that are listed. Chosen: they fit on a screen beside the rest."""
_MOST_FIELDS = 8
"""Names of a message's fields that are listed. Chosen: they fill two lines."""
_WIDTH = 110
"""Letters of a line of a list. Chosen: the width of a wide terminal."""


def info_lines(content: Mapping[str, Any]) -> Iterator[str]:
    """Return the lines for what ``info`` found."""
    kinds: dict[str, Callable[[Mapping[str, Any]], Iterator[str]]] = {
        "recording": _recording,
        "profile": _profile,
        "gains": _gains,
        "model": _model,
    }
    return kinds[content["kind"]](content)


def _recording(content: Mapping[str, Any]) -> Iterator[str]:
    kind = _FORMATS.get(content["format"], content["format"])
    made = content["count"] - content["records"]
    held = (
        f"{content['records']} records, from which {made} messages were made"
        if content["records"]
        else f"{made} messages"
    )
    head = f"{content['file']}: {kind}, {held}"
    if content["start_ns"] is not None:
        head += f", {content['duration_s']:.1f} s from {content['start'] or content['start_ns']}"
    yield head
    for damage in content["damage"]:
        yield f"  damaged: {damage['file']}: {'; '.join(damage['found'])}"
    recorded = content["recorded"] or {}
    if "vehicle" in recorded:
        yield f"  recorded by a monitor of {recorded['vehicle']}, fauio {recorded.get('fauio', '?')}"
    elif "converted_from" in recorded:
        yield f"  converted from {recorded['converted_from']}"
    yield from _link(content["link"])
    for system in content["systems"]:
        yield f"  system {system['system']}: {_system(system)}"
    yield from _alarms(content["alarms"])
    yield from _message_lines(content)
    if content["vehicle"] is not None:
        yield from _vehicle(content["vehicle"])
    elif content["messages"] and not content["fields"]:
        yield "  nothing to fit: no message holds attitude, accelerations or motor outputs with their times"
    if content["fields"]:
        yield "  numbers that the channels of a custom model can take (fauio fit --vehicle custom --model MODEL.toml):"
        for name, fields in content["fields"].items():
            yield from _listed(f"    {name}: ", _capped(fields, _MOST_FIELDS))


def _link(link: Mapping[str, float | None]) -> Iterator[str]:
    """Yield the statistics of the link, if messages came over one: other recordings' arrival times are their stamps."""
    delay_s, jitter_s, lost = (link[name] for name in ("delay_s", "jitter_s", "lost_share"))
    if delay_s is None or jitter_s is None or not (delay_s or jitter_s):
        return
    share = "" if lost is None else f", {100 * lost:.2g} % lost by their stamps"
    yield f"  came {1e3 * delay_s:.3g} ms later than the quickest on average, {1e3 * jitter_s:.3g} ms of jitter{share}"


def _system(system: Mapping[str, Any]) -> str:
    what = " of ".join(word for word in (system["type"], system["autopilot"]) if word and word != "invalid")
    armed = ", never armed" * bool(system["heartbeats"])
    if system["armed_s"]:
        armed = f", armed for {system['armed_s']:.0f} s"
    return f"{what or 'unknown'}, {system['messages']} messages{armed}"


def _alarms(alarms: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    if not alarms:
        return
    yield f"  {len(alarms)} alarm{'s' if len(alarms) > 1 else ''} recorded:"
    for event in alarms[:_MOST_ALARMS]:
        place = f"{event.get('observer')}/{event.get('channel')}"
        yield f"    {event.get('severity')}: {place}: {event.get('message')}"
    if len(alarms) > _MOST_ALARMS:
        yield f"    ... and {len(alarms) - _MOST_ALARMS} more"


def _message_lines(content: Mapping[str, Any]) -> Iterator[str]:
    messages = content["messages"]
    if not messages:
        yield "  no messages"
        return
    width = max(len("message"), *map(len, messages))
    yield f"  {'message':<{width}}  {'count':>9}  {'per second':>10}"
    for name, entry in messages.items():
        rate = "-" if entry["rate_hz"] is None else f"{entry['rate_hz']:.1f}"
        yield f"  {name:<{width}}  {entry['count']:>9}  {rate:>10}"


def _vehicle(vehicle: Mapping[str, Any]) -> Iterator[str]:
    whose = "these topics" if vehicle["system"] is None else f"system {vehicle['system']}"
    for name, entry in vehicle["inputs"].items():
        place = "" if entry["from"] is None else f", from {entry['from']}"
        yield f"  {entry['holds']}: {name} at {entry['rate_hz']:.3g} Hz{place}"
    if vehicle["never_armed"]:
        yield "  nothing to fit: the vehicle is never armed; record a flight. Of a flight with these messages:"
    yield f"  what fauio fit could make of {whose}:"
    for kind, fit in vehicle["fits"].items():
        # a vehicle that reports its type is of no other type, whatever its messages would allow
        if vehicle["likely"] not in (None, kind) and kind != "inertial":
            continue
        if not fit["possible"]:
            yield f"    {kind}: not possible: {fit['missing'][0]}"
            continue
        rate = "" if fit["rate_hz"] is None else f" at {fit['rate_hz']:.3g} Hz"
        yield from _listed(f"    {kind}{rate}: watches ", fit["watches"])
        messages = dict.fromkeys(place.partition(".")[0] for place in fit["channels"].values())
        yield from _listed("      from ", list(messages))
        for fact in fit["facts"]:
            yield from _listed("      ", fact.split(" "), " ")
        if fit["hides"]:
            yield from _listed("      hides some: ", fit["hides"].split(" "), " ")
        for missing in fit["missing"]:
            yield from _listed("      lacks ", missing.split(" "), " ")


def _profile(content: Mapping[str, Any]) -> Iterator[str]:
    phase = [word for word in ("armed", "airborne") if content["phase"][f"require_{word}"]]
    when = " and ".join(phase) or "always"
    yield f"{content['file']}: profile of '{content['name']}' ({content['vehicle']}), watches while {when}"
    yield from _listed("  reads ", content["messages"])
    for name, entry in content["observers"].items():
        bank = f", bank of {entry['hypotheses']}" if entry["hypotheses"] > 1 else ""
        size = f"{len(entry['states'])} states, {len(entry['inputs'])} inputs, {len(entry['outputs'])} outputs"
        yield f"  {name}: {entry['rate_hz']:g} Hz, {size}{bank}, {_certified(entry)}"
        width = max((len(channel) for channel in entry["alarms"]), default=0)
        for channel, rule in entry["alarms"].items():
            sees = f"; sees {rule['sees']}" if rule["sees"] else ""
            words = rule["unit"], rule["usual_command"]
            threshold, critical = (size_text(rule[key], *words) for key in ("threshold", "critical"))
            sizes = f"from {threshold}, critical {critical}"
            if rule["at_most"] is not None:
                sizes += f", off by {size_text(rule['at_most'], *words)} in the model's worst case"
            yield f"    {channel:<{width}}  {sizes}{sees}"


def _bound(content: Mapping[str, Any]) -> str:
    bound = "no certified bound" if content["sqrt_mu"] is None else f"sqrt(mu) {content['sqrt_mu']:.4g}"
    return f"{bound}, {_certified(content)}"


def _certified(content: Mapping[str, Any]) -> str:
    return "certificate holds" if content["certified"] else "not certified"


def _gains(content: Mapping[str, Any]) -> Iterator[str]:
    yield f"{content['file']}: gains for the model {content['model']} ({content['method']}, {content['rate_hz']:g} Hz)"
    yield f"  {_bound(content)}; one step is a product with a {content['matrix'][0]} x {content['matrix'][1]} matrix"
    yield from _names_text(content)


def _model(content: Mapping[str, Any]) -> Iterator[str]:
    rate = "" if content["rate_hz"] is None else f" at {content['rate_hz']:g} Hz"
    yield f"{content['file']}: {content['domain']} model '{content['name']}'{rate}"
    if content["description"]:
        yield f"  {content['description']}"
    yield from _names_text(content)
    for key in ("disturbances", "noises", "nonlinearities", "parameters"):
        if content[key]:
            yield from _listed(f"  {'free parameters' if key == 'parameters' else key}: ", content[key])
    yield f"  check: {content['check']}"


def _names_text(content: Mapping[str, Any]) -> Iterator[str]:
    for key in ("states", "inputs", "outputs"):
        yield from _listed(f"  {key} ({len(content[key])}): ", content[key])
    faults = [f"{fault['name']} ({fault['kind']})" for fault in content["faults"]]
    yield from _listed(f"  faults ({len(faults)}): ", faults)


def _capped(items: Sequence[str], most: int) -> list[str]:
    return [*items[:most], f"... {len(items) - most} more"] if len(items) > most else list(items)


def _listed(start: str, items: Sequence[str], comma: str = ", ") -> list[str]:
    """Return items after a heading, with a comma between them, in lines of bounded width."""
    indent = " " * (len(start) - len(start.lstrip()) + 2)
    text = start + comma.join(items)
    return wrap(text, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
