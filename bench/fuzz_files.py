"""Fuzz targets of files that users write and are given: configuration, profiles, models, gains."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path

from fuzz_adapters import START_NS
from fuzz_input import Draw, random_inputs
from fuzz_pipeline import QUAD, ROOT
from fuzz_target import Run, Target, only

from adapters.batch import pack
from adapters.errors import ConfigError, ModelError, ProfileError
from adapters.message import silence
from gains.plants.model_file import read_model
from gains.synthesis.gains_file import read_gains
from monitor.configuration.config import read_config
from monitor.pipeline import Pipeline
from monitor.profile import read_profile
from replay.demonstration.arm_profile import write_arm_profile


def _toml(folder: Path) -> Run:
    path = folder / "config.toml"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read_config(path)
        except ConfigError as error:
            assert all(line.startswith(("/", "command line")) for line in str(error).split("\n")), str(error)

    return run


def _toml_seeds() -> list[bytes]:
    example = (ROOT / "docs" / "config-example.toml").read_bytes()
    parts = [b"\n".join(example.split(b"\n")[k : k + 12]) for k in range(0, example.count(b"\n"), 8)]
    odd = [
        b"a = " + b"[" * 480 + b"]" * 480,
        b"mavlink = " + b"[" * 300 + b"]" * 300,
        b"a = " + b"[" * 5000,
        b"a = " + b"9" * 5000,
        b"a" + b".a" * 1500 + b" = 1",
        b"x = " + b"{a=" * 300 + b"1" + b"}" * 300,
        b'[[vehicle]]\nname = "a"\n[[vehicle]]\nname = "a"\n',
        b"prefix = 1\nmavlink = [1, 2020-01-01, 0x10, inf, nan]\n[metrics]\n",
        b'"\\ud800" = 1\n',
        b"recording = 5\n[recording.x]\n",
    ]
    return [example, *parts, *odd]


def _profile(folder: Path) -> Run:
    good = folder / "good"
    write_arm_profile(good)
    one = folder / "one"
    shutil.copytree(good, one)
    names = sorted(path.name for path in one.iterdir())
    contents = {name: (good / name).read_bytes() for name in names}

    def run(data: bytes) -> None:
        draw = Draw(data)
        name = draw.choice(names)
        content = draw.edited(contents[name]) if draw.number() % 2 else draw.rest()
        (one / name).write_bytes(content)
        try:
            with only(ProfileError):
                Pipeline(read_profile(one)).run(pack([silence(START_NS)]))
        finally:
            (one / name).write_bytes(contents[name])

    return run


def _profile_seeds() -> list[bytes]:
    text = (QUAD / "profile.toml").read_bytes()
    return [bytes([2, 0]) + text[:3000], *(bytes([k % 3, 1]) + one for k, one in enumerate(random_inputs(40, 120)))]


def _model(folder: Path) -> Run:
    model, gains = folder / "one.toml", folder / "one.json"

    def run(data: bytes) -> None:
        path, read = (model, read_model) if data[:1] != b"{" else (gains, read_gains)
        path.write_bytes(data)
        with only(ModelError):
            read(path)

    return run


def _model_seeds() -> list[bytes]:
    models = [(ROOT / "gains" / "models" / f"{name}.toml").read_bytes() for name in ("arm", "arm-disturbed")]
    frame = (
        'name = "m"\nstates = ["x", "y"]\noutputs = ["x"]\nA = [[0.0, 1.0], [0.0, 0.0]]\nC = [[1.0, 0.0]]\n'
        '[[nonlinearity]]\nexpression = "%s"\narguments = { %s }\ninto = "y"\n'
    )
    several = ", ".join(f"{name} = {{ x = 1.0 }}" for name in "abcdefgh")
    texts = [
        frame % ("sin(" * 38 + "a" + ")" * 38, "a = { x = 1.0 }"),
        frame % ("exp(cos(" * 15 + "a*a" + "))" * 15, "a = { x = 1.0 }"),
        frame % ("sin(a*b)*cos(c*d)*tanh(e*f)*atan(g*h)", several),
        frame % ("a**0.5 + 1/a", "a = { x = 1.0 }"),
        frame % ("1/sin(a)", "a = { x = 1.0 }"),
    ]
    gains = json.loads((QUAD / "motors.motor1.gains.json").read_text())
    small = copy.deepcopy(gains) | {"report": {}}
    for key in [key for key, value in gains.items() if isinstance(value, dict) and "rows" in value]:
        small[key] = {"shape": [0, 0], "rows": []}
    odd = [
        json.dumps(small | {key: value}).encode()
        for key in ("rate_hz", "K", "faults", "input_taps")
        for value in ([], None, 10**400, {"shape": [1 << 40, 0], "rows": []}, {"shape": [-1, 1], "rows": [[1]]})
    ]
    return [*models, *(text.encode() for text in texts), json.dumps(small).encode(), *odd]


TARGETS = (
    Target("config", "the daemon's configuration, and on which line of it keys stand", _toml, _toml_seeds, 1 << 13),
    Target("profile", "a profile's folder", _profile, _profile_seeds),
    Target("model", "model files and gains files", _model, _model_seeds, slow_s=10.0),
)
