"""Configuration of the daemon: its keys, their defaults, and how a TOML file is read, all mistakes at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

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
_Read = Callable[..., Any]

_BYTE: Mapping[str, Any] = {"at_least": 0, "at_most": 255}  # an id of MAVLink
_COUNT: Mapping[str, Any] = {"at_least": 1}  # a number of things, of which there has to be one


class Entry(NamedTuple):
    """A key besides its default: its description and example on the reference page, and how it is read.

    Its type (``kind``) decides that, within ``limits`` such as ``at_least`` and ``check``, unless it has a reader.
    """

    description: str = ""
    example: Any = None
    limits: Mapping[str, Any] = {}
    read: _Read | None = None
    kind: Any = None

    @property
    def choices(self) -> tuple[str, ...]:
        """Texts of which the key is one; empty if it may be any."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def table(self) -> type | None:
        """Class of the table, or the tables, that the key names; None if it has a value."""
        kind = get_args(self.kind)[0] if get_origin(self.kind) is tuple else self.kind
        return kind if is_dataclass(kind) and isinstance(kind, type) else None


def _key(default: Any, description: str, example: Any = None, *, read: _Read | None = None, **limits: Any) -> Any:
    """Return a key's field; the default itself is the example if none is given."""
    entry = Entry(description, default if example is None else example, limits, read)
    if isinstance(default, dict):
        return field(default_factory=dict, metadata={"entry": entry})
    return field(default=default, metadata={"entry": entry})


def _value(kind: Any, table: Table, key: str, limits: Mapping[str, Any]) -> Any:
    """Read a key by its type; ``limits`` are arguments of the table's method for that type."""
    shape, parts = get_origin(kind), get_args(kind)
    if shape is UnionType:  # None is the default of a key that is left out
        return _value(parts[0], table, key, limits)
    if isinstance(kind, type) and is_dataclass(kind):
        return read_keys(kind, table.table(key))
    if shape is Literal:
        return table.choice(key, parts)
    if shape is tuple:
        return table.texts(key, **limits) if parts[0] is str else table.choices(key, get_args(parts[0]))
    if shape is Mapping:
        return _by_name(parts[1], table.table(key), **limits)
    if kind is Path:
        return _path(table, key)
    reads: dict[Any, _Read] = {bool: table.boolean, int: table.integer, float: table.number, str: table.text}
    return reads[kind](key, **limits)


def _path(table: Table, key: str) -> Path:
    """Read a text as a path relative to the file.

    A :class:`pathlib.Path` did not come from the file and stays as it is.
    """
    value = table.raw(key)
    if isinstance(value, Path):
        return value
    return Path(table.file.name).parent / table.text(key, check=check.path)


def _by_name(kind: Any, table: Table, *, names: Callable[[str], None], **limits: Any) -> dict[str, Any]:
    """Read a table whose keys the user chooses."""
    values = {}
    for name in table:
        try:
            names(name)
        except ValueError as error:
            table.mistake(name, str(error))
        else:
            values[name] = _value(kind, table, name, limits)
    return values


def _listen(table: Table, key: str) -> str | None:
    address = table.text(key, check=check.host_port_or_off)
    return None if address == "off" else address


@dataclass(frozen=True)
class Vehicle:
    """One vehicle: the telemetry that is its own, and the profile by which it is monitored."""

    name: str | None = _key(
        None, "Name in topics; the profile's own where it is left out.", "copter-1", check=check.vehicle_name
    )
    profile: Path | None = _key(None, "Profile folder; the top level's `profile` where it is left out.", "quad/")
    system: int = _key(0, "MAVLink system id, 1 to 255; 0 takes the first system that fits the profile.", 1, **_BYTE)
    component: int = _key(1, "MAVLink component id, 1 is the autopilot; 0 takes any.", **_BYTE)
    zenoh: str | None = _key(
        None, "Key expression of telemetry of this vehicle alone.", "copter-1/telemetry/**", check=check.key_expression
    )
    out_of_service: tuple[str, ...] = _key(
        (), "Channels that raise nothing: a sensor known to be broken.", ["inertial/compass"], check=check.channel
    )
    latched: tuple[str, ...] = _key(
        (),
        "Channels whose alarms stay active after their cause is gone, until `fauio alarms reset`.",
        ["inertial/gps_north"],
        check=check.channel,
    )
    force: bool = _key(
        False, "Whether to watch it also where it says that it is another vehicle than the profile's.", True
    )


@dataclass(frozen=True)
class NewVehicles:
    """Vehicles that appear at run time: MAVLink systems that no `[[vehicle]]` names."""

    profile: Path | None = _key(None, "Profile folder of each; none are accepted where it is left out.", "quad/")
    name: str = _key("vehicle-{system}", "Name in topics; `{system}` becomes the id.", check=check.vehicle_template)
    limit: int = _key(16, "Largest number of them.", **_COUNT)

    def vehicle(self, system: int) -> Vehicle:
        """Return the vehicle with a MAVLink system id."""
        return Vehicle(name=self.name.replace("{system}", str(system)), profile=self.profile, system=system)


@dataclass(frozen=True)
class RecordingTable:
    """MCAP files one after the other; if there are too many, the oldest are deleted."""

    folder: Path | None = _key(None, "Folder they go to; none are written where it is left out.", "recordings/")
    file_mb: float = _key(256, "Size at which the next file begins, megabytes.", above=0)
    file_minutes: float = _key(60, "Time after which the next file begins, minutes.", above=0)
    budget_mb: float = _key(
        10_000,
        "Size of the files of all vehicles together, shared evenly, megabytes; those of former vehicles go first.",
        above=0,
    )


@dataclass(frozen=True)
class BlackBoxTable:
    """An MCAP file for each alarm, with the telemetry before and after it."""

    folder: Path | None = _key(None, "Folder they go to; none are written where it is left out.", "clips/")
    before_s: float = _key(30, "Begin of a clip before the alarm, seconds.", at_least=0, at_most=600)
    after_s: float = _key(30, "End of a clip after the alarm, seconds.", at_least=0, at_most=600)
    budget_mb: float = _key(1000, "Size of the clips of all vehicles together, as of recordings, megabytes.", above=0)


@dataclass(frozen=True)
class JournalTable:
    """The journal of alarm events, which survives restarts."""

    path: Path | None = _key(None, "SQLite file; events are kept in memory alone where it is left out.", "journal.db")
    max_events: int = _key(100_000, "Events kept; the oldest that belong to no active alarm go.", **_COUNT)


@dataclass(frozen=True)
class Signing:
    """MAVLink 2 signing."""

    key_file: Path | None = _key(None, "File with the key, 32 bytes or 64 hexadecimal digits.", "signing.key")
    require: bool | None = _key(
        None, "Whether unsigned packets are refused; with a key they are unless this says otherwise.", False
    )
    state_file: Path | None = _key(
        None,
        "File that keeps the newest time stamps of signatures across restarts; where it is left out, the journal's "
        "with `.signing` behind its name.",
        "signing.state",
    )


@dataclass(frozen=True)
class Send:
    """Packets that the daemon may send to vehicles; none by default."""

    allow: bool = _key(False, "Whether anything is sent to a vehicle.", True)
    rates: Mapping[str, float] = _key(
        {},
        "Message rates to request (MAV_CMD_SET_MESSAGE_INTERVAL), hertz, by message name.",
        {"ATTITUDE": 100},
        names=check.message_name,
        above=0,
        at_most=1000,
    )
    target_component: int = _key(1, "Component that is asked for them, 1 is the autopilot.", **_BYTE)
    source_system: int = _key(255, "MAVLink system id that the daemon sends as.", at_least=1, at_most=255)
    source_component: int = _key(191, "MAVLink component id that the daemon sends as.", at_least=1, at_most=255)


@dataclass(frozen=True)
class Commands:
    """Commands that operators may give over Zenoh (`fauio alarms ack` and the like)."""

    allow: tuple[AllowedCommand, ...] = _key(
        (), "Commands that are answered; none by default.", ["ack", "shelve", "unshelve", "reset"]
    )
    max_shelve_minutes: float = _key(480, "Longest time an alarm can be shelved.", above=0)
    default_shelve_minutes: float = _key(60, "Time if a request names none.", above=0)


@dataclass(frozen=True)
class Flood:
    """An alarm flood: more alarms than an operator can read; only the first ones are announced one by one."""

    raised: int = _key(10, "Alarms of a vehicle that make a flood ...", **_COUNT)
    within_s: float = _key(60, "... where they are raised within this time, seconds.", above=0)


@dataclass(frozen=True)
class Standby:
    """A second daemon that takes over if the first one fails."""

    enabled: bool = _key(False, "Whether this daemon waits while another one is there.", True)
    takeover_s: float = _key(
        0.5,
        "How long the other one has to be gone, seconds: a connection that breaks is back in less. One "
        "that is stopped hands over at once.",
        at_least=0,
        at_most=60,
    )
    key_file: Path | None = _key(
        None,
        "File with the secret that both daemons share, 64 hexadecimal digits: only who has it has a say in which is "
        "active, and in what happened.",
        "standby.key",
    )


@dataclass(frozen=True)
class Metrics:
    """Prometheus metrics and `/healthz`."""

    listen: str | None = _key(None, 'HOST:PORT, or "off".', "127.0.0.1:9464", read=_listen)


@dataclass(frozen=True)
class Notify:
    """Messages to people: e-mail, Slack, Telegram, ntfy, MQTT, webhooks and many more, or a program."""

    urls_file: Path | None = _key(
        None,
        "File with an [Apprise](https://appriseit.com/services/) URL a line, which hold secrets: chmod 600.",
        "notify.urls",
    )
    exec: tuple[str, ...] = _key(
        (),
        "Program and arguments, started without a shell; it gets a JSON object for each event, a line each, on its "
        "standard input.",
        ["/usr/local/bin/on-alarm", "--quiet"],
        check=check.argument,
    )
    exec_timeout_s: float = _key(
        10, "Time after which the program is killed, with what it has started, seconds.", above=0, at_most=600
    )
    on: tuple[Occasion, ...] = _key(
        OCCASIONS,
        "Occasions: an alarm is raised, is or becomes critical, cleared; a vehicle flies and is not watched.",
        ["critical", "cleared", "blind"],
    )
    per_minute: float = _key(
        6, "Largest rate of messages per URL; what comes faster makes one summary.", above=0, at_most=600
    )


@dataclass(frozen=True)
class GroundStation:
    """Alarms on the operator's ground station: heartbeat, computer status and texts of an onboard computer."""

    url: str | None = _key(
        None,
        "Where they go: a ground station or a MAVLink router; nothing is sent where it is left out.",
        "udpout:127.0.0.1:14551",
        check=check.udp_target,
    )
    component: int = _key(
        COMPANION, "MAVLink component id that they are sent as, with the vehicle's system id.", at_least=2, at_most=255
    )
    per_minute: float = _key(20, "Largest rate of messages; more are summed up.", above=0, at_most=600)


@dataclass(frozen=True)
class Ros:
    """ROS 2 over Zenoh (rmw_zenoh): `/diagnostics`."""

    diagnostics: bool = _key(False, "Whether `diagnostic_msgs/DiagnosticArray` is published once a second.", True)
    domain: int = _key(0, "ROS_DOMAIN_ID of those who read it.", at_least=0, at_most=232)


@dataclass(frozen=True)
class Rerun:
    """The live view."""

    mode: Literal["off", "serve", "spawn"] = _key(
        "off", "`serve`: viewers connect to the daemon; `spawn`: it starts one.", "serve"
    )
    port: int = _key(
        9876, "Port of this machine that viewers connect to; Rerun's own default.", at_least=1, at_most=65535
    )
    memory_mb: int = _key(256, "Memory for what a viewer sees when it joins.", **_COUNT)


def _vehicles(table: Table, key: str) -> tuple[Vehicle, ...]:
    value = table.raw(key)
    named = isinstance(value, str)
    tables = [Table(table.file, (key, 0), {"name": value})] if named else table.tables(key)
    return tuple(read_keys(Vehicle, found) for found in tables)


@dataclass(frozen=True)
class Config:
    """The configuration of `fauio run`. Every key is optional."""

    profile: Path | None = _key(
        None, "Profile folder of vehicles that name none; `fauio run PROFILE` sets it.", "quad/"
    )
    mavlink: tuple[str, ...] = _key(
        (), "MAVLink link or links.", "udpin:127.0.0.1:14550", check=check.mavlink_url, single=True
    )
    zenoh: tuple[str, ...] = _key(
        (),
        "Key expression or expressions of telemetry over Zenoh.",
        "arm/telemetry",
        check=check.key_expression,
        single=True,
    )
    vehicle: tuple[Vehicle, ...] = _key(
        (), "Tables `[[vehicle]]`, one each; or a text, the name of the only one.", "copter-1", read=_vehicles
    )
    new_vehicles: NewVehicles = NewVehicles()
    listen: tuple[str, ...] = _key(
        (DEFAULT_ENDPOINT,), "Zenoh endpoints to listen on.", [DEFAULT_ENDPOINT], check=check.endpoint, single=True
    )
    connect: tuple[str, ...] = _key(
        (), "Zenoh endpoints to connect to.", ["tcp/192.168.1.2:7447"], check=check.endpoint, single=True
    )
    allow_public: bool = _key(False, "Whether anything may listen where other machines reach it.", True)
    zenoh_config: Path | None = _key(
        None, "Zenoh's own configuration (JSON5): TLS, users, access control.", "zenoh.json5"
    )
    zenoh_mode: Literal["peer", "router", "client"] = _key(
        "peer",
        "Zenoh mode of the daemon. `router` where it connects to a router or to other daemons: a router "
        "passes nothing between its peers.",
    )
    zenoh_types: Mapping[str, str] = _key(
        {},
        "Types of telemetry over Zenoh by key expression: JSON unless said otherwise.",
        {"rover/imu": "sensor_msgs/msg/Imu"},
        names=check.key_expression,
        check=check.message_type,
    )
    definitions: Path | None = _key(None, "Folder of message definitions (`.msg`) of further types.", "px4_msgs/")
    force: bool = _key(
        False,
        "Whether to watch all vehicles, also those that say they are others than their profiles'; `--force` sets it.",
        True,
    )
    prefix: str = _key(DEFAULT_PREFIX, "What all topics begin with.", "fauio", check=check.key_chunks)
    estimate_rate_hz: float = _key(
        10, "Largest rate of published estimates per observer, hertz; 0 publishes none.", at_least=0
    )
    record: Path | None = _key(None, "One MCAP file to record to, without end; see `[recording]`.", "flight.mcap")
    inbox: int = _key(20_000, "Messages that wait at most; the oldest are dropped and counted.", **_COUNT)
    batch_ms: float = _key(
        20,
        "Telemetry that comes within this time is processed together, milliseconds: less work for each message, and "
        "alarms that come so much later at most. 0 processes at once whatever has arrived.",
        at_least=0,
        at_most=1000,
    )
    log_format: Literal["auto", "json", "text"] = _key(
        "auto", "Log lines on stderr; `auto`: text on a terminal, JSON otherwise."
    )
    recording: RecordingTable = RecordingTable()
    black_box: BlackBoxTable = BlackBoxTable()
    journal: JournalTable = JournalTable()
    signing: Signing = Signing()
    send: Send = Send()
    commands: Commands = Commands()
    flood: Flood = Flood()
    standby: Standby = Standby()
    metrics: Metrics = Metrics()
    notify: Notify = Notify()
    ground_station: GroundStation = GroundStation()
    ros: Ros = Ros()
    rerun: Rerun = Rerun()

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
    """Return default and entry of each key of a table's class; a key without an entry is a table ``[key]``."""
    kinds, found = get_type_hints(kind), {}
    for key in fields(kind):
        default = key.default_factory() if callable(key.default_factory) else key.default
        found[key.name] = default, key.metadata.get("entry", Entry())._replace(kind=kinds[key.name])
    return found


def read_keys(kind: type[T], table: Table) -> T:
    """Read a table into its class; mistakes are recorded in the table's file, and defaults replace wrong values."""
    known = entries(kind)
    table.examples = {key: entry.example for key, (_, entry) in known.items() if entry.example is not None}
    values = {}
    for key, (_, entry) in known.items():
        if table.has(key):
            value = entry.read(table, key) if entry.read else _value(entry.kind, table, key, entry.limits)
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
