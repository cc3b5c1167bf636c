"""Damaged recordings of every kind: no traceback, and no message is lost but where the damage is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

import pytest
from corrupted_logs import DAMAGES, KINDS, PACKED, Damaged, blocks, damaged_files, unpacked
from foreign_logs import write_foreign_profile
from onboard_flights import messages_of

import fauio
from adapters.errors import TelemetryError
from adapters.logs.recordings import Recording
from monitor.profile import Profile

LONG = pytest.mark.long

# Messages of these have no checksum but that of whole blocks, or none at all.
_UNPROTECTED = {"tlog", "unchunked", "ros2-plain", "ulog", "dataflash"}
# Without any checksum a record that lost its end takes in what follows, and with it the beginning of other records.
_MOST_TAKEN_IN = {"ulog": 10, "dataflash": 10}
_QUAD = Path("replay/data/quad")
_LINE = re.compile(r"fauio: [^\n]+\n")


def read(path: Path) -> list[str]:
    try:
        return [repr(message) for message in messages_of(Recording(path).records())]
    except TelemetryError as error:
        assert "\n" not in str(error)
        return []


def untimed(messages: list[str]) -> list[str]:
    """Return messages without their arrival: records before the first that has a time take the time of that one."""
    return [re.sub(r"received_ns=\d+", "", message) for message in messages]


def check(kind: str, packed: str, folder: Path, count: int, seed: int) -> None:
    """Read damaged copies of a recording and compare with the blocks that stand before and behind the damage."""
    suffix, write = KINDS[kind]
    path = folder / f"log{suffix}"
    write(path)
    plain, whole = path.read_bytes(), read(path)
    parts = blocks(suffix, plain)
    counts = [0, *accumulate(block.messages for block in parts)]
    assert counts[-1] == len(whole) >= 600
    assert len(parts) > 10
    order = {message: number for number, message in enumerate(whole)}
    path = folder / f"log{suffix}{packed}"
    data = PACKED[packed](plain)
    for name, damaged in damaged_files(data, count, seed):
        path.write_bytes(damaged.data)
        found = read(path)
        what = f"{name}, seed {seed}, {len(damaged.data)} bytes, intact before {damaged.before}"
        intact = len(unpacked(packed, data[: damaged.before]))
        before = counts[sum(block.stop <= intact for block in parts)]
        assert untimed(found[:before]) == untimed(whole[:before]), what
        defined = all(block.stop <= damaged.before for block in parts if block.defines)
        if not packed and (defined or kind not in _MOST_TAKEN_IN):
            behind = counts[sum(block.start < len(data) - damaged.behind for block in parts)]
            lost = set(whole[behind:]) - set(found)
            assert len(lost) <= _MOST_TAKEN_IN.get(kind, 0), (
                f"{what}: {len(lost)} of {len(whole) - behind} messages behind the damage are lost"
            )
        numbers = [order[message] for message in found if message in order]
        if kind not in _UNPROTECTED:
            assert len(numbers) == len(found), what
        if kind not in _UNPROTECTED or not packed:
            # decompressors make of zeros what stood before, again and again, and check it at the very end
            assert numbers == sorted(numbers), what
            # a record whose instance was hit may equal that of the sensor beside it
            assert len(numbers) - len(set(numbers)) <= (kind in _MOST_TAKEN_IN), what


# how compressed files are damaged does not depend on what is in them: all kinds are in the long tests
@pytest.mark.parametrize(
    ("kind", "packed"), [*((kind, "") for kind in KINDS), ("tlog", ".xz"), ("mcap", ".gz"), ("dataflash", ".gz")]
)
def test_only_what_the_damage_hit_is_lost(kind: str, packed: str, tmp_path: Path) -> None:
    check(kind, packed, tmp_path, len(DAMAGES), 7)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("packed", PACKED)
@pytest.mark.parametrize("kind", KINDS)
def test_only_what_the_damage_hit_is_lost_in_many_files(kind: str, packed: str, seed: int, tmp_path: Path) -> None:
    check(kind, packed, tmp_path, 20 * len(DAMAGES), 1000 + seed)


@pytest.fixture(scope="module")
def profiles(arm_profile: Profile, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a profile for each kind of recording: the arm's, for its topic in recordings of others, a quadrotor's."""
    folder = tmp_path_factory.mktemp("profiles")
    (folder / "mavlink").mkdir()
    for name, content in arm_profile.files.items():
        (folder / "mavlink" / name).write_bytes(content)
    arm, foreign = folder / "mavlink", write_foreign_profile(arm_profile, folder / "foreign")
    return {kind: {"tlog": arm, "mcap": arm, "ulog": _QUAD, "dataflash": _QUAD}.get(kind, foreign) for kind in KINDS}


def damaged_copies(kind: str, packed: str, folder: Path, count: int, seed: int) -> Iterator[tuple[Path, Damaged]]:
    suffix, write = KINDS[kind]
    path = folder / f"log{suffix}"
    write(path)
    data = PACKED[packed](path.read_bytes())
    path = folder / f"log{suffix}{packed}"
    for _, damaged in damaged_files(data, count, seed):
        path.write_bytes(damaged.data)
        yield path, damaged


def check_commands(
    kind: str, packed: str, profile: Path, folder: Path, capsys: pytest.CaptureFixture[str], count: int, seed: int
) -> None:
    """Run the commands on damaged copies: done, or one line that says why not; damage is told."""
    for number, (path, damaged) in enumerate(damaged_copies(kind, packed, folder, count, seed)):
        for command in (
            ["info", str(path), *["--json"] * (number % 2)],
            ["convert", str(path), "-o", str(folder / "out.mcap"), "--json"],
            ["replay", str(profile), str(path), "--json"],
        ):
            status = fauio.main(command)
            said = capsys.readouterr()
            assert status in (0, 2), command
            lines = _LINE.findall(said.err)
            assert "".join(lines) == said.err
            if status == 2:
                assert len(lines) == 1
                assert path.name in lines[0]
            elif command[-1] == "--json":
                assert isinstance(json.loads(said.out)["damage"], list)
            else:
                assert path.name in said.out
        assert damaged.data == path.read_bytes()


@pytest.mark.parametrize("kind", ["tlog", "ros2", *(pytest.param(kind, marks=LONG) for kind in ("ulog", "dataflash"))])
def test_commands_on_damaged_recordings_end_with_a_result_or_a_line(
    kind: str, profiles: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_commands(kind, "", profiles[kind], tmp_path, capsys, len(DAMAGES), 11)


@pytest.mark.long
@pytest.mark.parametrize("packed", PACKED)
@pytest.mark.parametrize("kind", KINDS)
def test_commands_on_many_damaged_recordings_end_with_a_result_or_a_line(
    kind: str, packed: str, profiles: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_commands(kind, packed, profiles[kind], tmp_path, capsys, 5 * len(DAMAGES), 12)
