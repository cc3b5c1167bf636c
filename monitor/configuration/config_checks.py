"""Contradictions within a configuration whose single values are valid."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from adapters.toml_tables import KeyPath
from monitor.configuration.config_values import listens_beyond_loopback

if TYPE_CHECKING:
    from monitor.configuration.config import Config, Vehicle


class Conflict(NamedTuple):
    """A contradiction: the key at which it is reported, the message, and the other keys that it follows from."""

    path: KeyPath
    what: str
    others: tuple[KeyPath, ...] = ()


def conflicts(config: Config) -> Iterator[Conflict]:
    """Yield all contradictions of a configuration, missing files included."""
    yield from _vehicles(config)
    yield from _telemetry(config)
    yield from link_conflicts(config)
    yield from _sizes(config)
    yield from _standby(config)
    yield from _ground_station(config)
    yield from _profiles(config)
    yield from _channels(config)


def link_conflicts(config: Config) -> Iterator[Conflict]:
    """Yield the contradictions between the keys that name telemetry, missing files included."""
    yield from _listeners(config)
    yield from _ports(config)
    yield from _sending(config)
    yield from _files(config)


def _vehicles(config: Config) -> Iterator[Conflict]:
    if not config.vehicles and config.new_vehicles.profile is None:
        yield Conflict(
            ("profile",),
            "is missing: no vehicle to monitor; name a profile folder here or as 'fauio run PROFILE', or write "
            "[[vehicle]] tables or [new_vehicles]",
            (("vehicle",), ("new_vehicles", "profile")),
        )
    for k, vehicle in enumerate(config.vehicles):
        if vehicle.profile is None:
            yield Conflict(
                ("vehicle", k),
                "has no profile; name the folder that 'fauio fit' made: profile = \"quad/\" here or at the top level, "
                "or PROFILE on the command line",
                (("profile",),),
            )
        for channel in sorted(set(vehicle.out_of_service) & set(vehicle.latched)):
            path: KeyPath = ("vehicle", k, "latched")
            yield Conflict(path, f"names {channel}, which is out of service; leave it out of one of the two")
    for (i, first), (k, second) in combinations(enumerate(config.vehicles), 2):
        if first.name is not None and first.name == second.name:
            yield Conflict(
                ("vehicle", k, "name"), f"is '{second.name}', as is vehicle[{i}]'s; each needs a name of its own"
            )
        if first.name is second.name is None and first.profile == second.profile:
            what = f"is missing: the profile's own is vehicle[{i}]'s too; give each a name of its own"
            yield Conflict(("vehicle", k, "name"), what, (("vehicle", i, "name"),))
        if _same_system(first, second):
            system, component = "a system id", "any component"
            if first.system:
                system, component = f"system {first.system}", f"component {second.component or first.component}"
            yield Conflict(
                ("vehicle", k, "system"),
                f"is {second.system}, as is vehicle[{i}]'s, so that both want {system} ({component}); "
                "give each a system id of its own",
                (("vehicle", i, "system"), ("vehicle", i, "component"), ("vehicle", k, "component")),
            )


def _same_system(first: Vehicle, second: Vehicle) -> bool:
    """Return whether two vehicles claim the same MAVLink packets; one with its own Zenoh keys and no id claims none."""
    if first.system != second.system or (first.system == 0 and (first.zenoh or second.zenoh)):
        return False
    return first.component == second.component or 0 in (first.component, second.component)


def _telemetry(config: Config) -> Iterator[Conflict]:
    shared = bool(config.mavlink or config.zenoh)
    own = [vehicle.zenoh is not None for vehicle in config.vehicles]
    sources: tuple[KeyPath, ...] = (("mavlink",), ("zenoh",))
    if not shared and not any(own):
        yield Conflict(
            ("mavlink",),
            "is missing: no telemetry to listen to; give --mavlink URL or --zenoh KEYEXPR, or set it in --config",
            (("zenoh",), *(("vehicle", k, "zenoh") for k in range(len(own)))),
        )
    elif not shared:
        for k, has_own in enumerate(own):
            if not has_own:
                what = "has no telemetry to listen to; give it 'zenoh', or set 'mavlink' at the top level"
                yield Conflict(("vehicle", k), what, (*sources, ("vehicle", k, "zenoh")))
    if config.new_vehicles.profile is not None and not config.mavlink and (shared or any(own)):
        yield Conflict(
            ("new_vehicles", "profile"),
            "is set, but vehicles are told apart by their MAVLink ids; set 'mavlink' too",
            (("mavlink",),),
        )


def _listeners(config: Config) -> Iterator[Conflict]:
    if config.allow_public:
        return
    for path, address in _addresses(config):
        if listens_beyond_loopback(address):
            what = f"is '{address}', which other machines reach; use 127.0.0.1, or allow_public = true (--allow-public)"
            yield Conflict(path, what, (("allow_public",),))


def _addresses(config: Config) -> list[tuple[KeyPath, str]]:
    """Return the addresses that may be listened on, by the key that names them."""
    places: list[tuple[KeyPath, str]] = [(("mavlink", k), url) for k, url in enumerate(config.mavlink)]
    places += [(("listen", k), endpoint) for k, endpoint in enumerate(config.listen)]
    return places if config.metrics.listen is None else [*places, (("metrics", "listen"), config.metrics.listen)]


def _ports(config: Config) -> Iterator[Conflict]:
    """Yield a conflict for each key with an address on which another key listens already."""
    kinds = {"udp": "udp", "udpin": "udp", "tcpin": "tcp"}
    places = []
    for path, address in _addresses(config):
        kind, _, place = address.partition("/" if path[0] == "listen" else ":")
        if path[0] == "metrics":
            places.append((path, address, "tcp", address))
        elif path[0] == "listen" or kind in kinds:
            places.append((path, address, kinds.get(kind, kind), place))
    for first, second in combinations(places, 2):
        # port 0 is any free port
        if first[2:] == second[2:] and not first[3].endswith(":0"):
            what = f"is '{second[1]}', where '{first[1]}' listens already; give each a port of its own"
            yield Conflict(second[0], what, (first[0],))


def _sending(config: Config) -> Iterator[Conflict]:
    if config.signing.require and config.signing.key_file is None:
        yield Conflict(
            ("signing", "require"), "is true without a key; name it with key_file", (("signing", "key_file"),)
        )
    if config.send.allow:
        return
    allow: tuple[KeyPath, ...] = (("send", "allow"),)
    if config.send.rates:
        yield Conflict(
            ("send", "rates"), "are to be requested, but nothing may be sent; set allow = true in [send]", allow
        )
    for k, url in enumerate(config.mavlink):
        if url.startswith("udpout:"):
            what = (
                f"is '{url}', where nothing comes back unless something is sent; let the vehicle send here and use "
                "udpin:HOST:PORT, or set allow = true in [send]"
            )
            yield Conflict(("mavlink", k), what, allow)


def _ground_station(config: Config) -> Iterator[Conflict]:
    """Yield vehicles for whose telemetry our own packets would be taken, once a router forwards them."""
    if config.ground_station.url is None:
        return
    for k, vehicle in enumerate(config.vehicles):
        if vehicle.component in (0, config.ground_station.component):
            what = (
                f"is {vehicle.component}, so that the packets of [ground_station] (component "
                f"{config.ground_station.component}) would be taken for telemetry; name the autopilot's, 1"
            )
            yield Conflict(("vehicle", k, "component"), what, (("ground_station", "component"),))


def _sizes(config: Config) -> Iterator[Conflict]:
    recording, commands = config.recording, config.commands
    if config.record is not None and recording.folder is not None:
        yield Conflict(
            ("record",), "is set beside 'recording.folder'; leave one of them out", (("recording", "folder"),)
        )
    if recording.budget_mb < 2 * recording.file_mb:
        yield Conflict(
            ("recording", "budget_mb"),
            f"is {recording.budget_mb:g}, less than two files of {recording.file_mb:g}; it must be at least that",
            (("recording", "file_mb"),),
        )
    if commands.default_shelve_minutes > commands.max_shelve_minutes:
        yield Conflict(
            ("commands", "default_shelve_minutes"),
            f"is {commands.default_shelve_minutes:g}; it must be at most max_shelve_minutes, "
            f"{commands.max_shelve_minutes:g}",
            (("commands", "max_shelve_minutes"),),
        )


def _standby(config: Config) -> Iterator[Conflict]:
    if config.standby.enabled and config.standby.key_file is None:
        what = (
            "is true without a key, so that anybody on the network could silence both; name one with key_file, made by "
            "'(umask 077; openssl rand -hex 32 > standby.key)', the same for both"
        )
        yield Conflict(("standby", "enabled"), what, (("standby", "key_file"),))


def _profiles(config: Config) -> Iterator[Conflict]:
    folders: list[tuple[KeyPath, Path | None]] = [
        (("profile",), config.profile),
        (("new_vehicles", "profile"), config.new_vehicles.profile),
    ]
    folders += [(("vehicle", k, "profile"), vehicle.profile) for k, vehicle in enumerate(config.vehicle)]
    for path, folder in folders:
        if folder is not None and not folder.is_dir():
            yield Conflict(path, f"is {folder}: no such folder; name the one that 'fauio fit' made")


def _files(config: Config) -> Iterator[Conflict]:
    folder = config.definitions
    if folder is not None and not folder.is_dir():
        yield Conflict(("definitions",), f"is {folder}: no such folder; name the one with the .msg files")
    files: list[tuple[KeyPath, Path | None]] = [
        (("zenoh_config",), config.zenoh_config),
        (("signing", "key_file"), config.signing.key_file),
        (("standby", "key_file"), config.standby.key_file),
        (("notify", "urls_file"), config.notify.urls_file),
    ]
    for path, file in files:
        if file is not None and not file.is_file():
            yield Conflict(path, f"is {file}: no such file; paths are relative to the configuration file")


def _channels(config: Config) -> Iterator[Conflict]:
    for k, vehicle in enumerate(config.vehicles):
        named = [
            (key, place, channel)
            for key in ("out_of_service", "latched")
            for place, channel in enumerate(getattr(vehicle, key))
        ]
        known = _channels_of(vehicle.profile) if named and vehicle.profile is not None else ()
        for key, place, channel in named:
            if known and channel not in known:
                yield Conflict(
                    ("vehicle", k, key, place),
                    f"is '{channel}', which is no channel of {vehicle.profile}; its channels are {', '.join(known)}",
                    (("profile",), ("vehicle", k, "profile")),
                )


def _channels_of(folder: Path) -> list[str]:
    """Return all channels that can have an alarm with a profile; none if it cannot be read, which the start reports."""
    from monitor.alarms.desk import FLOOD_KEY
    from monitor.pipeline import Pipeline
    from monitor.profile import read_profile

    try:
        pipeline = Pipeline(read_profile(folder))
    except (ValueError, OSError):
        return []
    return sorted("/".join(key) for key in (*pipeline.channels, FLOOD_KEY))
