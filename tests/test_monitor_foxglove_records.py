"""Foxglove draws a recording by itself: lines of a log, places on a map, and a layout of channels that exist."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from loopback import START_NS
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from own_records import own_records

from adapters.batch import pack
from adapters.logs.recordings import packed, read_recording
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.profile import read_profile
from monitor.recording.foxglove_records import GPS, TEXTS, FoxgloveRecords
from monitor.recording.record_encoder import RecordEncoder
from replay.player import play, play_batches

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def topics(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Return what a plain reader finds in the recording of a flight with a drifting GPS, by topic."""
    path = tmp_path_factory.mktemp("foxglove") / "flight.mcap"
    profile = read_profile(ROOT / "replay" / "data" / "quad")
    flight = list(read_recording(ROOT / "tests" / "data" / "copter_gps_drift05.tlog.xz"))
    text = Message(MAVLINK, "STATUSTEXT", flight[500].received_ns, {"severity": 6, "text": "Mission"}, 1, 1)
    play(profile, [*flight[:500], text, *flight[500:]], record=path)
    content = defaultdict(list)
    with path.open("rb") as stream:
        decoders = DecoderFactory()
        for schema, channel, record in make_reader(stream).iter_messages():
            if channel.message_encoding == "json":
                message = json.loads(record.data)
                if len(content[channel.topic]) < 20:
                    jsonschema.validate(message, json.loads(schema.data))
            else:
                message = decoders.decoder_for(channel.message_encoding, schema)(record.data)
            content[channel.topic].append(message)
    return content


def test_the_log_has_the_alarms_with_what_people_say_of_their_size(topics: dict[str, list[Any]]) -> None:
    lines = topics["/fauio/log"]
    assert len(lines) == len(topics["/fauio/alarm"])
    assert "gps_north raised: GPS is" in lines[0]["message"]
    assert lines[0]["message"].endswith(" m)")
    assert lines[0]["level"] in (3, 4)


def test_the_track_goes_on_where_gps_is_pulled_away(topics: dict[str, list[Any]]) -> None:
    gps, track = (topics[f"/fauio/{name}"] for name in ("gps", "track"))
    at = {fix["timestamp"]["sec"] * 10 + fix["timestamp"]["nsec"] // 100_000_000: fix["latitude"] for fix in gps}
    apart = [
        (at[fix["timestamp"]["sec"] * 10 + fix["timestamp"]["nsec"] // 100_000_000] - fix["latitude"]) * 111_319.5
        for fix in track
    ]
    assert np.abs(apart[:50]).max() < 0.5
    assert apart[-1] == pytest.approx(3.8, abs=0.5)
    assert len(track) > 0.9 * len(gps)


def test_texts_of_the_autopilot_are_lines_and_a_receiver_without_a_fix_has_no_place() -> None:
    encoder = RecordEncoder(())
    batch = pack(
        [
            Message(MAVLINK, "STATUSTEXT", START_NS, {"severity": 2, "text": "EKF lane switch"}, 1, 1),
            Message(MAVLINK, "STATUSTEXT", START_NS, {"severity": 99, "text": "nonsense"}, 1, 1),
            Message(MAVLINK, "GPS_RAW_INT", START_NS, {"lat": 0, "lon": 0, "alt": 0}, 1, 1),
            Message(ZENOH, "robot/fix", START_NS, {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}),
        ]
    )
    log, place = FoxgloveRecords(encoder).batch(batch)
    assert (encoder.topics[log[0]], encoder.topics[place[0]]) == (TEXTS, GPS)
    assert json.loads(log[1]) | {"timestamp": None} == {
        "timestamp": None,
        "level": 5,
        "message": "EKF lane switch",
        "name": "autopilot",
        "file": "",
        "line": 0,
    }
    assert json.loads(place[1])["latitude"] == 47.0


def asked(found: Any) -> Iterator[str]:
    """Yield every path of a message that a layout asks for."""
    if isinstance(found, dict):
        for key, value in found.items():
            if key in ("value", "topicPath", "topicToRender", "followTopic") and isinstance(value, str):
                yield value
            elif key == "topicColors":
                yield from value
            else:
                yield from asked(value)
    elif isinstance(found, list):
        for value in found:
            yield from asked(value)


def test_the_layout_asks_for_channels_and_fields_that_exist(topics: dict[str, list[Any]]) -> None:
    layout = json.loads((ROOT / "foxglove" / "fauio-layout.json").read_text())
    paths = [*asked(layout["configById"])]
    assert len(paths) > 15
    for path in paths:
        topic, *fields = path.split(".")
        message = topics[topic][-1]
        for field in fields:
            message = message[field] if isinstance(message, dict) else getattr(message, field)
    panels = set(layout["configById"])
    assert {name for name in json.dumps(layout["layout"]).split('"') if "!" in name} == panels


def test_what_is_drawn_does_not_depend_on_how_a_flight_is_cut(tmp_path: Path) -> None:
    profile = read_profile(ROOT / "replay" / "data" / "quad")
    flight = list(read_recording(ROOT / "tests" / "data" / "copter_gps_drift05.tlog.xz"))[:3000]
    for name, size in (("few", len(flight)), ("many", 100)):
        play_batches(profile, packed(flight, size), record=tmp_path / f"{name}.mcap")
    few, many = (own_records([tmp_path / f"{name}.mcap"]) for name in ("few", "many"))
    assert few == many
