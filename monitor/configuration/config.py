"""Configuration of the daemon: what may be set, its defaults, and how a TOML file becomes one, all errors at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from monitor.configuration.config_checks import conflicts, link_conflicts
from monitor.configuration.config_reading import read_model
from monitor.configuration.config_values import (
    ChannelPath,
    Endpoints,
    HostPortOrOff,
    KeyChunks,
    KeyExpression,
    KeyExpressions,
    Listed,
    MavlinkUrls,
    MessageName,
    MessageType,
    PathBesideFile,
    VehicleName,
    VehicleTemplate,
)

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
DEFAULT_PREFIX = "fauio"

Command = Literal["ack", "shelve", "unshelve", "reset"]
_Positive = Annotated[float, Field(gt=0)]
_Count = Annotated[int, Field(ge=1)]
_Id = Annotated[int, Field(ge=0, le=255)]
_Rate = Annotated[float, Field(gt=0, le=1000)]


class _Table(BaseModel):
    """What all tables have in common: nothing unknown, no conversions, no changes."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)


class Vehicle(_Table):
    """One vehicle: whose telemetry it is, and by which profile it is monitored."""

    name: VehicleName | None = Field(
        default=None, description="Name in topics; the profile's own where it is left out.", examples=["copter-1"]
    )
    profile: PathBesideFile | None = Field(
        default=None, description="Profile folder; the top level's `profile` where it is left out.", examples=["quad/"]
    )
    system: _Id = Field(
        default=0,
        description="MAVLink system id, 1 to 255; 0 takes the first system that fits the profile.",
        examples=[1],
    )
    component: _Id = Field(
        default=1, description="MAVLink component id, 1 is the autopilot; 0 takes any.", examples=[1]
    )
    zenoh: KeyExpression | None = Field(
        default=None,
        description="Key expression of telemetry of this vehicle alone.",
        examples=["copter-1/telemetry/**"],
    )
    out_of_service: Annotated[tuple[ChannelPath, ...], Listed] = Field(
        default=(),
        description="Channels that raise nothing: a sensor known to be broken.",
        examples=[["inertial/compass"]],
    )
    latched: Annotated[tuple[ChannelPath, ...], Listed] = Field(
        default=(),
        description="Channels whose alarms stand after their cause is gone, until `fauio alarms reset`.",
        examples=[["inertial/gps_north"]],
    )


class NewVehicles(_Table):
    """Vehicles that appear at run time: MAVLink systems that no `[[vehicle]]` names."""

    profile: PathBesideFile | None = Field(
        default=None, description="Profile folder of each; none are taken where it is left out.", examples=["quad/"]
    )
    name: VehicleTemplate = Field(
        default="vehicle-{system}",
        description="Name in topics; `{system}` becomes the id.",
        examples=["vehicle-{system}"],
    )
    limit: _Count = Field(default=16, description="How many are taken at most.", examples=[16])

    def vehicle(self, system: int) -> Vehicle:
        """Return the vehicle with a MAVLink system id."""
        return Vehicle(name=self.name.replace("{system}", str(system)), profile=self.profile, system=system)


class Recording(_Table):
    """MCAP files one after the other, the oldest deleted where they become too many."""

    folder: PathBesideFile | None = Field(
        default=None, description="Folder they go to; none are written where it is left out.", examples=["recordings/"]
    )
    file_mb: _Positive = Field(
        default=256, description="Size at which the next file begins, megabytes.", examples=[256]
    )
    file_minutes: _Positive = Field(
        default=60, description="Time after which the next file begins, minutes.", examples=[60]
    )
    budget_mb: _Positive = Field(
        default=10_000, description="Size of all files together, megabytes.", examples=[10_000]
    )


class BlackBox(_Table):
    """An MCAP file of its own for each alarm, with what came before and after it."""

    folder: PathBesideFile | None = Field(
        default=None, description="Folder they go to; none are written where it is left out.", examples=["clips/"]
    )
    before_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=30, description="Begin of a clip before the alarm, seconds.", examples=[30]
    )
    after_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=30, description="End of a clip after the alarm, seconds.", examples=[30]
    )
    budget_mb: _Positive = Field(default=1000, description="Size of all clips together, megabytes.", examples=[1000])


class JournalTable(_Table):
    """The journal of alarm events, which survives restarts."""

    path: PathBesideFile | None = Field(
        default=None,
        description="SQLite file; events are kept in memory alone where it is left out.",
        examples=["journal.db"],
    )
    max_events: _Count = Field(
        default=100_000, description="Events kept; the oldest that belong to no active alarm go.", examples=[100_000]
    )


class Signing(_Table):
    """MAVLink 2 signing."""

    key_file: PathBesideFile | None = Field(
        default=None, description="File with the key, 32 bytes or 64 hexadecimal digits.", examples=["signing.key"]
    )
    require: bool = Field(default=False, description="Whether unsigned packets are refused.", examples=[True])


class Send(_Table):
    """What the daemon sends to vehicles; nothing unless it is allowed."""

    allow: bool = Field(default=False, description="Whether anything is sent to a vehicle.", examples=[True])
    rates: Mapping[MessageName, _Rate] = Field(
        default={},
        description="Message rates to request (MAV_CMD_SET_MESSAGE_INTERVAL), hertz, by message name.",
        examples=[{"ATTITUDE": 100}],
    )
    target_component: _Id = Field(
        default=1, description="Component that is asked for them, 1 is the autopilot.", examples=[1]
    )
    source_system: Annotated[int, Field(ge=1, le=255)] = Field(
        default=255, description="MAVLink system id that the daemon sends as.", examples=[255]
    )
    source_component: Annotated[int, Field(ge=1, le=255)] = Field(
        default=191, description="MAVLink component id that the daemon sends as.", examples=[191]
    )


class Commands(_Table):
    """What operators may do over Zenoh (`fauio alarms ack` and the like)."""

    allow: Annotated[tuple[Command, ...], Listed] = Field(
        default=(),
        description="Commands that are answered; none by default.",
        examples=[["ack", "shelve", "unshelve", "reset"]],
    )
    max_shelve_minutes: _Positive = Field(
        default=480, description="Longest time an alarm can be shelved.", examples=[480]
    )
    default_shelve_minutes: _Positive = Field(default=60, description="Time where none is asked for.", examples=[60])


class Flood(_Table):
    """When so many alarms come that nobody can read them: only the first ones are told one by one."""

    raised: _Count = Field(default=10, description="Alarms of a vehicle that make a flood ...", examples=[10])
    within_s: _Positive = Field(
        default=60, description="... where they are raised within this time, seconds.", examples=[60]
    )


class Standby(_Table):
    """A second daemon that takes over where the first one goes."""

    enabled: bool = Field(
        default=False, description="Whether this daemon waits while another one is there.", examples=[True]
    )
    takeover_s: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.5,
        description="How long the other one has to be gone, seconds: a connection that breaks is back in less. One "
        "that is stopped hands over at once.",
        examples=[0.5],
    )


class Metrics(_Table):
    """Prometheus metrics and `/healthz`."""

    listen: HostPortOrOff = Field(default=None, description='HOST:PORT, or "off".', examples=["127.0.0.1:9464"])


class Rerun(_Table):
    """The live view."""

    mode: Literal["off", "serve", "spawn"] = Field(
        default="off", description="`serve`: viewers connect to the daemon; `spawn`: it starts one.", examples=["serve"]
    )
    memory_mb: _Count = Field(default=256, description="Memory for what a viewer sees when it joins.", examples=[256])


def _vehicles(value: Any) -> Any:
    return ({"name": value},) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value


class Config(_Table):
    """What `fauio run` does. Every key may be left out."""

    profile: PathBesideFile | None = Field(
        default=None,
        description="Profile folder of vehicles that name none; `fauio run PROFILE` sets it.",
        examples=["quad/"],
    )
    mavlink: MavlinkUrls = Field(default=(), description="MAVLink link or links.", examples=["udpin:127.0.0.1:14550"])
    zenoh: KeyExpressions = Field(
        default=(), description="Key expression or expressions of telemetry over Zenoh.", examples=["arm/telemetry"]
    )
    vehicle: Annotated[tuple[Vehicle, ...], BeforeValidator(_vehicles)] = Field(
        default=(),
        description="Tables `[[vehicle]]`, one each; or a text, the name of the only one.",
        examples=["copter-1"],
    )
    new_vehicles: NewVehicles = NewVehicles()
    listen: Endpoints = Field(
        default=(DEFAULT_LISTEN,), description="Zenoh endpoints to listen on.", examples=[[DEFAULT_LISTEN]]
    )
    connect: Endpoints = Field(
        default=(), description="Zenoh endpoints to connect to.", examples=[["tcp/192.168.1.2:7447"]]
    )
    allow_public: bool = Field(
        default=False, description="Whether anything may listen where other machines reach it.", examples=[True]
    )
    zenoh_config: PathBesideFile | None = Field(
        default=None,
        description="Zenoh's own configuration (JSON5): TLS, users, access control.",
        examples=["zenoh.json5"],
    )
    zenoh_mode: Literal["peer", "router", "client"] = Field(
        "peer",
        description="Zenoh mode of the daemon. `router` where it connects to a router or to other daemons: a router "
        "passes nothing between its peers.",
        examples=["peer"],
    )
    zenoh_types: Mapping[KeyExpression, MessageType] = Field(
        default={},
        description="Types of telemetry over Zenoh by key expression: JSON unless said otherwise.",
        examples=[{"rover/imu": "sensor_msgs/msg/Imu"}],
    )
    definitions: PathBesideFile | None = Field(
        default=None, description="Folder of message definitions (`.msg`) of further types.", examples=["px4_msgs/"]
    )
    prefix: KeyChunks = Field(default=DEFAULT_PREFIX, description="What all topics begin with.", examples=["fauio"])
    estimate_rate_hz: Annotated[float, Field(ge=0)] = Field(
        default=10,
        description="Largest rate of published estimates per observer, hertz; 0 publishes none.",
        examples=[10],
    )
    record: PathBesideFile | None = Field(
        default=None,
        description="One MCAP file to record to, without end; see `[recording]`.",
        examples=["flight.mcap"],
    )
    inbox: _Count = Field(
        default=20_000, description="Messages that wait at most; the oldest are dropped and counted.", examples=[20_000]
    )
    log_format: Literal["auto", "json", "text"] = Field(
        default="auto",
        description="Log lines on stderr; `auto`: text on a terminal, JSON otherwise.",
        examples=["auto"],
    )
    recording: Recording = Recording()
    black_box: BlackBox = BlackBox()
    journal: JournalTable = JournalTable()
    signing: Signing = Signing()
    send: Send = Send()
    commands: Commands = Commands()
    flood: Flood = Flood()
    standby: Standby = Standby()
    metrics: Metrics = Metrics()
    rerun: Rerun = Rerun()

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """Vehicles known at start, each with its profile: one where a profile is all that is given."""
        if not self.vehicle and self.profile is not None:
            return (Vehicle(profile=self.profile),)
        return tuple(
            vehicle if vehicle.profile is not None else vehicle.model_copy(update={"profile": self.profile})
            for vehicle in self.vehicle
        )


def read_config(path: str | Path | None, given: Mapping[str, Any] | None = None, *, links_only: bool = False) -> Config:
    """Read a configuration file and check all of it.

    Parameters
    ----------
    path : str | Path | None
        The TOML file; None for none.
    given : Mapping[str, Any] | None
        Keys of the top level from the command line, which override the file's. A text is a path relative to the
        file also here; give a :class:`pathlib.Path` for one relative to the working directory.
    links_only : bool
        Whether only links matter: there may be no vehicle yet, and profiles may not have been made.

    Returns
    -------
    Config
        With paths relative to the file made relative to the working directory.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, has keys that are unknown, values of the wrong kind, or values that
        contradict each other. The message has a line for each: ``FILE:LINE: 'key' what is wrong; what to do``.
    """
    return read_model(Config, path, given or {}, link_conflicts if links_only else conflicts)
