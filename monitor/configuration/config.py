"""Configuration of the daemon: its keys, their defaults, and how a TOML file is read, all mistakes at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, get_args

from adapters.errors import ConfigError
from adapters.mavlink.companion import COMPANION
from adapters.toml_tables import Table, read_toml
from adapters.zenoh.zenoh_session import DEFAULT_ENDPOINT
from monitor.configuration import config_values as check
from monitor.configuration.config_checks import conflicts, link_conflicts
from monitor.notify.notices import OCCASIONS, Occasion

DEFAULT_PREFIX = "fauio"

AllowedCommand = Literal["ack", "shelve", "unshelve", "reset"]
T = TypeVar("T")
_Read = Callable[[Table, str], Any]


class Entry(NamedTuple):
    """A key besides its type and default: the function that reads it, and its description on the reference page."""

    read: _Read
    description: str = ""
    example: Any = None
    choices: tuple[str, ...] = ()
    table: type | None = None


def _key(default: Any, read: _Read, description: str, example: Any = None, *choices: str) -> Any:
    """Return a key's field; the default itself is the example if none is given."""
    shown = default if example is None else example
    return field(default=default, metadata={"entry": Entry(read, description, shown, choices)})


def _by_name(read: _Read, description: str, example: Any) -> Any:
    return field(default_factory=dict, metadata={"entry": Entry(read, description, example)})


def _one_of(default: str, choices: Sequence[str], example: str, description: str) -> Any:
    return _key(default, lambda table, key: table.choice(key, choices), description, example, *choices)


def _text(check: Callable[[str], None]) -> _Read:
    return lambda table, key: table.text(key, check=check)


def _texts(check: Callable[[str], None], *, single: bool = False) -> _Read:
    return lambda table, key: table.texts(key, check, single=single)


def _whole(at_least: float, at_most: float = math.inf) -> _Read:
    return lambda table, key: table.integer(key, at_least=at_least, at_most=at_most)


def _number(**bounds: float) -> _Read:
    return lambda table, key: table.number(key, **bounds)


def _truth(table: Table, key: str) -> bool:
    return table.boolean(key)


def _path(table: Table, key: str) -> Path:
    """Read a text as a path relative to the file.

    A :class:`pathlib.Path` did not come from the file and stays as it is.
    """
    value = table.raw(key)
    if isinstance(value, Path):
        return value
    return Path(table.file.name).parent / table.text(key, check=check.path)


def _listen(table: Table, key: str) -> str | None:
    address = table.text(key, check=check.host_port_or_off)
    return None if address == "off" else address


def _table_of(names: Callable[[str], None], read: _Read) -> _Read:
    """Return the reader of a table whose keys the user chooses."""

    def read_all(table: Table, key: str) -> dict[str, Any]:
        values = {}
        below = table.table(key)
        for name in below:
            try:
                names(name)
            except ValueError as error:
                below.mistake(name, str(error))
            else:
                values[name] = read(below, name)
        return values

    return read_all


_ID = _whole(0, 255)  # a byte of MAVLink
_COUNT = _whole(1)  # one at least
_POSITIVE = _number(above=0)


@dataclass(frozen=True)
class Vehicle:
    """One vehicle: the telemetry that is its own, and the profile by which it is monitored."""

    name: str | None = _key(
        None, _text(check.vehicle_name), "Name in topics; the profile's own where it is left out.", "copter-1"
    )
    profile: Path | None = _key(None, _path, "Profile folder; the top level's `profile` where it is left out.", "quad/")
    system: int = _key(0, _ID, "MAVLink system id, 1 to 255; 0 takes the first system that fits the profile.", 1)
    component: int = _key(1, _ID, "MAVLink component id, 1 is the autopilot; 0 takes any.")
    zenoh: str | None = _key(
        None, _text(check.key_expression), "Key expression of telemetry of this vehicle alone.", "copter-1/telemetry/**"
    )
    out_of_service: tuple[str, ...] = _key(
        (), _texts(check.channel), "Channels that raise nothing: a sensor known to be broken.", ["inertial/compass"]
    )
    latched: tuple[str, ...] = _key(
        (),
        _texts(check.channel),
        "Channels whose alarms stay active after their cause is gone, until `fauio alarms reset`.",
        ["inertial/gps_north"],
    )
    force: bool = _key(
        False, _truth, "Whether to watch it also where it says that it is another vehicle than the profile's.", True
    )


@dataclass(frozen=True)
class NewVehicles:
    """Vehicles that appear at run time: MAVLink systems that no `[[vehicle]]` names."""

    profile: Path | None = _key(None, _path, "Profile folder of each; none are accepted where it is left out.", "quad/")
    name: str = _key("vehicle-{system}", _text(check.vehicle_template), "Name in topics; `{system}` becomes the id.")
    limit: int = _key(16, _COUNT, "Largest number of them.")

    def vehicle(self, system: int) -> Vehicle:
        """Return the vehicle with a MAVLink system id."""
        return Vehicle(name=self.name.replace("{system}", str(system)), profile=self.profile, system=system)


@dataclass(frozen=True)
class RecordingTable:
    """MCAP files one after the other; if there are too many, the oldest are deleted."""

    folder: Path | None = _key(None, _path, "Folder they go to; none are written where it is left out.", "recordings/")
    file_mb: float = _key(256, _POSITIVE, "Size at which the next file begins, megabytes.")
    file_minutes: float = _key(60, _POSITIVE, "Time after which the next file begins, minutes.")
    budget_mb: float = _key(
        10_000,
        _POSITIVE,
        "Size of the files of all vehicles together, shared evenly, megabytes; those of former vehicles go first.",
    )


@dataclass(frozen=True)
class BlackBoxTable:
    """An MCAP file for each alarm, with the telemetry before and after it."""

    folder: Path | None = _key(None, _path, "Folder they go to; none are written where it is left out.", "clips/")
    before_s: float = _key(30, _number(at_least=0, at_most=600), "Begin of a clip before the alarm, seconds.")
    after_s: float = _key(30, _number(at_least=0, at_most=600), "End of a clip after the alarm, seconds.")
    budget_mb: float = _key(1000, _POSITIVE, "Size of the clips of all vehicles together, as of recordings, megabytes.")


@dataclass(frozen=True)
class JournalTable:
    """The journal of alarm events, which survives restarts."""

    path: Path | None = _key(
        None, _path, "SQLite file; events are kept in memory alone where it is left out.", "journal.db"
    )
    max_events: int = _key(100_000, _COUNT, "Events kept; the oldest that belong to no active alarm go.")


@dataclass(frozen=True)
class Signing:
    """MAVLink 2 signing."""

    key_file: Path | None = _key(None, _path, "File with the key, 32 bytes or 64 hexadecimal digits.", "signing.key")
    require: bool | None = _key(
        None, _truth, "Whether unsigned packets are refused; with a key they are unless this says otherwise.", False
    )
    state_file: Path | None = _key(
        None,
        _path,
        "File that keeps the newest time stamps of signatures across restarts; where it is left out, the journal's "
        "with `.signing` behind its name.",
        "signing.state",
    )


@dataclass(frozen=True)
class Send:
    """Packets that the daemon may send to vehicles; none by default."""

    allow: bool = _key(False, _truth, "Whether anything is sent to a vehicle.", True)
    rates: Mapping[str, float] = _by_name(
        _table_of(check.message_name, _number(above=0, at_most=1000)),
        "Message rates to request (MAV_CMD_SET_MESSAGE_INTERVAL), hertz, by message name.",
        {"ATTITUDE": 100},
    )
    target_component: int = _key(1, _ID, "Component that is asked for them, 1 is the autopilot.")
    source_system: int = _key(255, _whole(1, 255), "MAVLink system id that the daemon sends as.")
    source_component: int = _key(191, _whole(1, 255), "MAVLink component id that the daemon sends as.")


@dataclass(frozen=True)
class Commands:
    """Commands that operators may give over Zenoh (`fauio alarms ack` and the like)."""

    allow: tuple[AllowedCommand, ...] = _key(
        (),
        lambda table, key: table.choices(key, get_args(AllowedCommand)),
        "Commands that are answered; none by default.",
        ["ack", "shelve", "unshelve", "reset"],
    )
    max_shelve_minutes: float = _key(480, _POSITIVE, "Longest time an alarm can be shelved.")
    default_shelve_minutes: float = _key(60, _POSITIVE, "Time if a request names none.")


@dataclass(frozen=True)
class Flood:
    """An alarm flood: more alarms than an operator can read; only the first ones are announced one by one."""

    raised: int = _key(10, _COUNT, "Alarms of a vehicle that make a flood ...")
    within_s: float = _key(60, _POSITIVE, "... where they are raised within this time, seconds.")


@dataclass(frozen=True)
class Standby:
    """A second daemon that takes over if the first one fails."""

    enabled: bool = _key(False, _truth, "Whether this daemon waits while another one is there.", True)
    takeover_s: float = _key(
        0.5,
        _number(at_least=0, at_most=60),
        "How long the other one has to be gone, seconds: a connection that breaks is back in less. One "
        "that is stopped hands over at once.",
    )
    key_file: Path | None = _key(
        None,
        _path,
        "File with the secret that both daemons share, 64 hexadecimal digits: only who has it has a say in which is "
        "active, and in what happened.",
        "standby.key",
    )


@dataclass(frozen=True)
class Metrics:
    """Prometheus metrics and `/healthz`."""

    listen: str | None = _key(None, _listen, 'HOST:PORT, or "off".', "127.0.0.1:9464")


@dataclass(frozen=True)
class Notify:
    """Messages to people: e-mail, Slack, Telegram, ntfy, MQTT, webhooks and many more, or a program."""

    urls_file: Path | None = _key(
        None,
        _path,
        "File with an [Apprise](https://appriseit.com/services/) URL a line, which hold secrets: chmod 600.",
        "notify.urls",
    )
    exec: tuple[str, ...] = _key(
        (),
        _texts(check.argument),
        "Program and arguments, started without a shell; it gets a JSON object for each event, a line each, on its "
        "standard input.",
        ["/usr/local/bin/on-alarm", "--quiet"],
    )
    exec_timeout_s: float = _key(
        10, _number(above=0, at_most=600), "Time after which the program is killed, with what it has started, seconds."
    )
    on: tuple[Occasion, ...] = _key(
        OCCASIONS,
        lambda table, key: table.choices(key, OCCASIONS),
        "Occasions: an alarm is raised, is or becomes critical, cleared; a vehicle flies and is not watched.",
        ["critical", "cleared", "blind"],
    )
    per_minute: float = _key(
        6, _number(above=0, at_most=600), "Largest rate of messages per URL; what comes faster makes one summary."
    )


@dataclass(frozen=True)
class GroundStation:
    """Alarms on the operator's ground station: heartbeat, computer status and texts of an onboard computer."""

    url: str | None = _key(
        None,
        _text(check.udp_target),
        "Where they go: a ground station or a MAVLink router; nothing is sent where it is left out.",
        "udpout:127.0.0.1:14551",
    )
    component: int = _key(
        COMPANION, _whole(2, 255), "MAVLink component id that they are sent as, with the vehicle's system id."
    )
    per_minute: float = _key(20, _number(above=0, at_most=600), "Largest rate of messages; more are summed up.")


@dataclass(frozen=True)
class Ros:
    """ROS 2 over Zenoh (rmw_zenoh): `/diagnostics`."""

    diagnostics: bool = _key(
        False, _truth, "Whether `diagnostic_msgs/DiagnosticArray` is published once a second.", True
    )
    domain: int = _key(0, _whole(0, 232), "ROS_DOMAIN_ID of those who read it.")


@dataclass(frozen=True)
class Rerun:
    """The live view."""

    mode: Literal["off", "serve", "spawn"] = _one_of(
        "off", ("off", "serve", "spawn"), "serve", "`serve`: viewers connect to the daemon; `spawn`: it starts one."
    )
    port: int = _key(9876, _whole(1, 65535), "Port of this machine that viewers connect to; Rerun's own default.")
    memory_mb: int = _key(256, _COUNT, "Memory for what a viewer sees when it joins.")


def _section(kind: type) -> Any:
    """Return the field of a table ``[key]``, all of whose keys are optional."""
    entry = Entry(lambda table, key: read_keys(kind, table.table(key)), table=kind)
    return field(default=kind(), metadata={"entry": entry})


def _vehicles(table: Table, key: str) -> tuple[Vehicle, ...]:
    value = table.raw(key)
    named = isinstance(value, str)
    tables = [Table(table.file, (key, 0), {"name": value})] if named else table.tables(key)
    return tuple(read_keys(Vehicle, found) for found in tables)


@dataclass(frozen=True)
class Config:
    """The configuration of `fauio run`. Every key is optional."""

    profile: Path | None = _key(
        None, _path, "Profile folder of vehicles that name none; `fauio run PROFILE` sets it.", "quad/"
    )
    mavlink: tuple[str, ...] = _key(
        (), _texts(check.mavlink_url, single=True), "MAVLink link or links.", "udpin:127.0.0.1:14550"
    )
    zenoh: tuple[str, ...] = _key(
        (),
        _texts(check.key_expression, single=True),
        "Key expression or expressions of telemetry over Zenoh.",
        "arm/telemetry",
    )
    vehicle: tuple[Vehicle, ...] = field(
        default=(),
        metadata={
            "entry": Entry(
                _vehicles,
                "Tables `[[vehicle]]`, one each; or a text, the name of the only one.",
                "copter-1",
                table=Vehicle,
            )
        },
    )
    new_vehicles: NewVehicles = _section(NewVehicles)
    listen: tuple[str, ...] = _key(
        (DEFAULT_ENDPOINT,), _texts(check.endpoint, single=True), "Zenoh endpoints to listen on.", [DEFAULT_ENDPOINT]
    )
    connect: tuple[str, ...] = _key(
        (), _texts(check.endpoint, single=True), "Zenoh endpoints to connect to.", ["tcp/192.168.1.2:7447"]
    )
    allow_public: bool = _key(False, _truth, "Whether anything may listen where other machines reach it.", True)
    zenoh_config: Path | None = _key(
        None, _path, "Zenoh's own configuration (JSON5): TLS, users, access control.", "zenoh.json5"
    )
    zenoh_mode: Literal["peer", "router", "client"] = _one_of(
        "peer",
        ("peer", "router", "client"),
        "peer",
        "Zenoh mode of the daemon. `router` where it connects to a router or to other daemons: a router "
        "passes nothing between its peers.",
    )
    zenoh_types: Mapping[str, str] = _by_name(
        _table_of(check.key_expression, _text(check.message_type)),
        "Types of telemetry over Zenoh by key expression: JSON unless said otherwise.",
        {"rover/imu": "sensor_msgs/msg/Imu"},
    )
    definitions: Path | None = _key(
        None, _path, "Folder of message definitions (`.msg`) of further types.", "px4_msgs/"
    )
    force: bool = _key(
        False,
        _truth,
        "Whether to watch all vehicles, also those that say they are others than their profiles'; `--force` sets it.",
        True,
    )
    prefix: str = _key(DEFAULT_PREFIX, _text(check.key_chunks), "What all topics begin with.", "fauio")
    estimate_rate_hz: float = _key(
        10, _number(at_least=0), "Largest rate of published estimates per observer, hertz; 0 publishes none."
    )
    record: Path | None = _key(
        None, _path, "One MCAP file to record to, without end; see `[recording]`.", "flight.mcap"
    )
    inbox: int = _key(20_000, _COUNT, "Messages that wait at most; the oldest are dropped and counted.")
    batch_ms: float = _key(
        20,
        _number(at_least=0, at_most=1000),
        "Telemetry that comes within this time is processed together, milliseconds: less work for each message, and "
        "alarms that come so much later at most. 0 processes at once whatever has arrived.",
    )
    log_format: Literal["auto", "json", "text"] = _one_of(
        "auto", ("auto", "json", "text"), "auto", "Log lines on stderr; `auto`: text on a terminal, JSON otherwise."
    )
    recording: RecordingTable = _section(RecordingTable)
    black_box: BlackBoxTable = _section(BlackBoxTable)
    journal: JournalTable = _section(JournalTable)
    signing: Signing = _section(Signing)
    send: Send = _section(Send)
    commands: Commands = _section(Commands)
    flood: Flood = _section(Flood)
    standby: Standby = _section(Standby)
    metrics: Metrics = _section(Metrics)
    notify: Notify = _section(Notify)
    ground_station: GroundStation = _section(GroundStation)
    ros: Ros = _section(Ros)
    rerun: Rerun = _section(Rerun)

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """Vehicles known at start, each with its profile; a single one if only a profile is given."""
        if not self.vehicle and self.profile is not None:
            return (Vehicle(profile=self.profile),)
        return tuple(
            vehicle if vehicle.profile is not None else replace(vehicle, profile=self.profile)
            for vehicle in self.vehicle
        )


def entries(kind: type) -> dict[str, tuple[Any, Entry]]:
    """Return default and entry of each key of a table's class."""
    return {
        key.name: (key.default_factory() if callable(key.default_factory) else key.default, key.metadata["entry"])
        for key in fields(kind)
    }


def read_keys(kind: type[T], table: Table) -> T:
    """Read a table into its class; mistakes are recorded in the table's file, and defaults replace wrong values."""
    known = entries(kind)
    table.examples = {key: entry.example for key, (_, entry) in known.items() if entry.example is not None}
    values = {}
    for key, (_, entry) in known.items():
        if table.has(key):
            value = entry.read(table, key)
            if entry.table is not None or table.good(key):
                values[key] = value
    table.done(_homes())
    return kind(**values)


@cache
def _homes() -> dict[str, tuple[str, ...]]:
    """Return the tables that contain a key, by key; an empty text is the top level."""
    homes: dict[str, tuple[str, ...]] = {}
    for name, (_, entry) in entries(Config).items():
        for key in entries(entry.table) if entry.table is not None else ():
            homes[key] = (*homes.get(key, ()), name)
    return homes | dict.fromkeys(entries(Config), ("",))


def read_config(path: str | Path | None, given: Mapping[str, Any] | None = None, *, links_only: bool = False) -> Config:
    """Read a configuration file, if one is named, and check all of it; paths become relative to the working directory.

    ``given`` are keys of the top level from the command line, which override the file's. A text is a path relative to
    the file also here; give a :class:`pathlib.Path` for one relative to the working directory. With ``links_only``
    there may be no vehicle yet, and profiles may not have been made.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, has keys that are unknown, values of the wrong kind, or values that
        contradict each other. The message has a line for each: ``FILE:LINE: 'key' what is wrong; what to do``.
    """
    mend = "docs/config-example.toml is one to begin with"
    file = read_toml(path, ConfigError, overrides=given, mend=mend)
    config = read_keys(Config, file.root)
    contradictions = (link_conflicts if links_only else conflicts)(config)
    # a contradiction to a wrong value follows from that mistake; all are checked before any is recorded
    for conflict in [
        conflict
        for conflict in contradictions
        if all(file.good(path, keys_below=False) for path in (conflict.path, *conflict.others))
    ]:
        file.mistake(conflict.path, conflict.what)
    file.check()
    return config
