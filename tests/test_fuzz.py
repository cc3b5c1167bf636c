"""Every parser of outside bytes against hypothesis' bytes: the fuzzer's targets without the fuzzer (bench/fuzz.py)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from fuzz_targets import TARGETS

from monitor.profile import Profile

EXAMPLES = 12
SLOW = {"cuts": 3, "model": 3, "pipeline-arm": 4, "pipeline-quad": 4, "profile": 4, "subscriber": 6}


FOUND = {
    "minutes that no float can hold": ("commands", b'\1{"channel": "motors/motor1", "minutes": ' + b"9" * 400 + b"}"),
    "text that UTF-8 cannot hold": ("commands", b'\0{"channel": "motors/motor1", "by": "\\ud800"}'),
    "a database whose table has no readable name": (
        "journal",
        bytes.fromhex(
            "8924d52ac8a32d19ed9438c76012719f13e6bc1e9293cede8c535345393f822ee3904920ed147f3e593caf59f5d1ffba"
            "9c483c5eb168c6f33000484489d52ac8a32d408c6920506109e4f3556b766b19ed9434c76078"
        ),
    ),
    "times inside times": ("zenoh", b"\0\0\1" + b'{"header":{"stamp":' + b'{"sec":' * 480 + b"1" + b"}" * 482),
    "elements of no bytes": ("definition", b"A[] a\n===\nMSG: x_msgs/A\nuint8[0] b\0\xff\xff\xff\xff"),
    "an estimate that no float can hold": ("subscriber", b'{"id":"a","estimate":' + b"9" * 400 + b"}"),
}
"""Inputs that were once too much, by what was in them."""


@pytest.fixture(scope="module")
def made(
    arm_profile: Profile, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[str], Callable[[bytes], None]]]:
    """Return what makes a target; the arm's observer is designed once for all."""

    def copied(folder: Path) -> Profile:
        folder.mkdir()
        for name, content in arm_profile.files.items():
            (folder / name).write_bytes(content)
        return arm_profile

    with pytest.MonkeyPatch.context() as patch:
        for module in ("fuzz_files", "fuzz_pipeline"):
            patch.setattr(f"{module}.write_arm_profile", copied)
        yield lambda name: TARGETS[name].make(tmp_path_factory.mktemp(name))


@st.composite
def changed(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """Return one of the fuzzer's first inputs with a piece of it overwritten, put in, or cut off."""
    data = draw(st.sampled_from(seeds))
    at = draw(st.integers(0, len(data)))
    piece = draw(st.binary(max_size=12))
    return draw(
        st.sampled_from([data[:at] + piece + data[at + len(piece) :], data[:at] + piece + data[at:], data[:at]])
    )


@pytest.mark.parametrize("name", TARGETS)
def test_a_parser_meets_nothing_that_it_does_not_expect(
    name: str, made: Callable[[str], Callable[[bytes], None]]
) -> None:
    target, run = TARGETS[name], made(name)
    seeds = [seed[: target.largest] for seed in target.seeds()]

    @given(data=st.binary(max_size=200) | changed(seeds))
    @settings(
        max_examples=SLOW.get(name, EXAMPLES),
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def meets(data: bytes) -> None:
        run(data)

    meets()


@pytest.mark.parametrize("what", FOUND)
def test_what_was_found_once_stays_mended(what: str, made: Callable[[str], Callable[[bytes], None]]) -> None:
    name, data = FOUND[what]
    made(name)(data)
