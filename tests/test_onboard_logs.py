"""A flight's onboard log gives the alarms that its telemetry gives, read, converted, damaged, attacked or fitted."""

from __future__ import annotations

import gzip
import json
import lzma
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from onboard_flights import BOOT_US, dataflash_of, messages_of, ulog_of

import fauio
from adapters.logs.recordings import Recording, read_batches, read_recording, recording_kind
from monitor.fitting.survey import common_rate_hz, of_one_vehicle, survey
from monitor.profile import Profile, read_profile
from monitor.vehicles.inertial.signals import strapdown_channels
from monitor.vehicles.kinds import fit_messages
from monitor.vehicles.multirotor.signals import multirotor_channels
from replay.player import Replay, interests, play_batches

KINDS = (".ulg", ".bin")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, data: Path) -> dict[str, Path]:
    """Return onboard logs of two recorded flights by name, those of PX4 also with motors at full rate."""
    folder = tmp_path_factory.mktemp("onboard")
    found = {}
    for flight in ("motor2_080", "gps_step25m"):
        messages = list(read_recording(data / f"copter_{flight}.tlog.xz"))
        found[f"{flight}.ulg"] = ulog_of(messages, folder / f"{flight}.ulg")
        found[f"{flight}.bin"] = dataflash_of(messages, folder / f"{flight}.bin")
        found[f"{flight}.motors"] = ulog_of(messages, folder / f"{flight}_motors.ulg", motors=True)
    return found


@cache
def shipped() -> Profile:
    return read_profile(Path(fauio.__file__).parent / "replay" / "data" / "quad")


@cache
def played(flight: Path) -> Replay:
    profile = shipped()
    return play_batches(profile, read_batches(flight, interests(profile)))


def is_px4(log: str) -> bool:
    """Return whether a made-up log is one of PX4, which the shipped profile's vehicle does not fly with."""
    return not log.endswith(".bin")


def told(found: Replay) -> list[tuple[str, str, str, int]]:
    return [(event.state, event.observer, event.channel, event.vehicle_time_ms) for event in found.events]


@pytest.mark.parametrize(
    "log", ["motor2_080.ulg", "motor2_080.bin", "motor2_080.motors", "gps_step25m.ulg", "gps_step25m.bin"]
)
def test_alarms_are_those_of_the_telemetry(logs: dict[str, Path], data: Path, log: str) -> None:
    profile = shipped()
    telemetry = played(data / f"copter_{log.partition('.')[0]}.tlog.xz")
    onboard = play_batches(profile, read_batches(logs[log], interests(profile)), force=is_px4(log))
    assert telemetry.events
    assert told(onboard) == told(telemetry)
    assert onboard.evidence == telemetry.evidence
    for ours, theirs in zip(onboard.events, telemetry.events, strict=True):
        assert ours.estimate == pytest.approx(theirs.estimate, rel=1e-2)
        unix_ns = (boot_us(log) + ours.vehicle_time_ms * 1000) * 1000
        assert ours.time_ns == pytest.approx(unix_ns, abs=2_000_000)


def boot_us(log: str) -> int:
    """Return Unix time of boot as the log tells it: flights without GPS messages tell none."""
    return BOOT_US if log.startswith("gps") else 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_converted_log_holds_every_record_typed(
    logs: dict[str, Path], tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = logs[f"motor2_080{kind}"], tmp_path / "flight.mcap"
    assert fauio.main(["convert", str(log), "-o", str(out), "--json"]) == 0
    whole = messages_of(Recording(log).records())
    assert json.loads(capsys.readouterr().out)["messages"] == len(whole)
    assert [repr(m) for m in messages_of(Recording(out).records())] == [repr(m) for m in whole]
    with out.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [(channel.topic, message.log_time) for _, channel, message, _ in reader.iter_decoded_messages()]
        summary = reader.get_summary()
    assert summary is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"protobuf"}
    assert sorted(decoded) == sorted((f"/{m.source}/{m.name}", m.received_ns) for m in whole)


@pytest.mark.parametrize("kind", KINDS)
def test_a_recorded_replay_replays_to_the_same_bits(logs: dict[str, Path], tmp_path: Path, kind: str) -> None:
    profile = shipped()
    log, force = logs[f"motor2_080{kind}"], is_px4(kind)
    first = play_batches(profile, read_batches(log), record=tmp_path / "a.mcap", force=force)
    again = play_batches(profile, read_batches(tmp_path / "a.mcap"), force=force)
    assert again.events == first.events
    assert again.samples == first.samples


@pytest.mark.parametrize(("suffix", "pack"), [(".xz", lzma.compress), (".gz", gzip.compress)])
@pytest.mark.parametrize("kind", KINDS)
def test_compressed_logs_are_recordings_too(
    logs: dict[str, Path], tmp_path: Path, kind: str, suffix: str, pack: Any
) -> None:
    log = logs[f"motor2_080{kind}"]
    packed = tmp_path / f"A{kind.upper()}{suffix}"
    packed.write_bytes(pack(log.read_bytes()))
    assert recording_kind(packed) == recording_kind(log)
    assert list(read_recording(packed, {"ATTITUDE"})) == list(read_recording(log, {"ATTITUDE"}))


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_that_breaks_off_behind_a_fault_still_shows_it(
    logs: dict[str, Path], tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = logs[f"motor2_080{kind}"].read_bytes()
    log = tmp_path / f"cut{kind}"
    log.write_bytes(raw[: len(raw) * 2 // 3])
    quad = str(Path(fauio.__file__).parent / "replay" / "data" / "quad")
    force = ["--force"] if is_px4(kind) else []
    assert fauio.main(["replay", quad, str(log), "--fail-on-alarm", *force]) == 4
    assert "motor2" in capsys.readouterr().out


def test_a_mapping_of_ones_own_decides_what_the_records_stand_for(
    logs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [f'servo{n}_raw = {{ field = "control[{m}]", scale = 1000, offset = 1000 }}' for n, m in swapped()]
    mapping = tmp_path / "swapped.toml"
    head = '[[SERVO_OUTPUT_RAW]]\ntopic = "actuator_motors"\ntime_usec = { field = "timestamp" }\n'
    mapping.write_text(head + "\n".join(lines))
    found = read_recording(logs["motor2_080.motors"], {"SERVO_OUTPUT_RAW"}, mapping)
    guessed = read_recording(logs["motor2_080.motors"], {"SERVO_OUTPUT_RAW"})
    for ours, theirs in zip(found, guessed, strict=True):
        assert (ours.fields["servo1_raw"], ours.fields["servo2_raw"]) == (
            theirs.fields["servo2_raw"],
            theirs.fields["servo1_raw"],
        )
    mapping.write_text("SERVO_OUTPUT_RAW = []")
    quad = str(Path(fauio.__file__).parent / "replay" / "data" / "quad")
    log = str(logs["motor2_080.motors"])
    assert fauio.main(["replay", quad, log, "--mapping", str(mapping), "--force"]) == 2
    assert "no samples" in capsys.readouterr().err
    mapping.write_text("SERVO_OUTPUT_RAW = 3")
    assert fauio.main(["replay", quad, log, "--mapping", str(mapping)]) == 2


def swapped() -> Iterator[tuple[int, int]]:
    yield from ((1, 1), (2, 0), (3, 2), (4, 3))


def test_an_attack_on_an_onboard_log_is_seen(logs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "attacked.mcap"
    order = ["--channel", "baro", "--kind", "bias", "--size", "15", "--start", "4"]
    assert fauio.main(["inject", str(logs["gps_step25m.ulg"]), *order, "-o", str(out)]) == 0
    assert "baro" in {event.channel for event in play_batches(shipped(), read_batches(out), force=True).events}


@pytest.mark.parametrize("kind", ["bin", "motors"])
def test_a_fit_sees_the_channels_and_rates_that_it_sees_in_telemetry(
    logs: dict[str, Path], data: Path, kind: str
) -> None:
    onboard, telemetry = (
        survey(of_one_vehicle(read_batches(log, fit_messages())))
        for log in (logs[f"gps_step25m.{kind}"], data / "copter_gps_step25m.tlog.xz")
    )
    assert multirotor_channels([onboard]) == multirotor_channels([telemetry])
    assert strapdown_channels(onboard.examples) == strapdown_channels(telemetry.examples)
    channels = [channel for some in multirotor_channels([onboard]) for channel in some]
    assert common_rate_hz([onboard], channels) == common_rate_hz([telemetry], channels) == 100.0


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ulg", "bin"])
def test_a_profile_fitted_on_onboard_logs_names_the_motor_in_telemetry(tmp_path: Path, data: Path, kind: str) -> None:
    healthy = []
    for flight in ("square", "vel_gusty"):
        messages = read_recording(data / f"copter_healthy_{flight}.tlog.xz")
        path = tmp_path / f"{flight}.{kind}"
        healthy.append(dataflash_of(messages, path) if kind == "bin" else ulog_of(messages, path, motors=True))
    folder = tmp_path / "quad"
    assert fauio.main(["fit", "--vehicle", "multirotor", *map(str, healthy), "-o", str(folder)]) == 0
    # the made-up log is one of PX4, which the telemetry is not
    found = play_batches(read_profile(folder), read_batches(data / "copter_motor2_080.tlog.xz"), force=kind == "ulg")
    assert {event.channel for event in found.events} == {"motor2"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("content", [b"", bytes(3000), b"ULog", b"\xa3\x95"])
def test_a_file_that_is_none_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, content: bytes
) -> None:
    log = tmp_path / f"no{kind}"
    log.write_bytes(content)
    assert fauio.main(["convert", str(log), "-o", str(tmp_path / "o.mcap")]) == 2
    said = capsys.readouterr().err
    assert f"no{kind}: not a " in said
    assert said.count("\n") == 1
