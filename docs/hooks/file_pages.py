"""The reference of files: the keys of a profile, a plant model and a gains file, from the classes they become."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
import shutil
import tempfile
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w
from markup import block, code, parameters_of, prose, table

import gains.plants.model_file
import replay
from adapters.channels import Channel
from gains.identification.free_model import Parameter
from gains.plants.plant import Fault, Nonlinearity, Plant
from gains.synthesis.gains_file import Gains
from monitor.alarms.alarm import MEASURED, TUNABLE, AlarmRule
from monitor.alarms.excuse import ExcuseRule
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.estimation.isolation_rule import METHODS, BankRule
from monitor.profile import ObserverProfile, Profile, read_profile
from monitor.sampling.gate import GateRule
from monitor.sampling.identity import Identity
from monitor.sampling.transform import TransformRule
from monitor.vehicles.inertial.strapdown import DEFAULTS, Strapdown
from monitor.vehicles.kinds import TRANSFORMS

_EXAMPLE = Path(replay.__file__).parent / "data" / "quad"
_HEAD = ("key", "type", "default", "what it is")
_FORMAT = ("format", "integer", "1, the version of this format.")
_NO_DEFAULT = object()
_MODEL_TABLES = ("G", "nonlinearities", "faults", "disturbances", "noises")

_PROFILE_HEAD = """# Keys of a profile

Every table of `profile.toml`, from the code that reads it. What a profile is, with examples: [profiles and
models](../profiles.md). A key that is none of these is an error that names the file and the keys there are. A key
without a default has to be there. Times are seconds.
"""
_MODEL_HEAD = """# Keys of a model

The TOML of a plant, `<observer>.model.toml` in a profile and MODEL.toml of `fauio check` and `fauio design`. With
examples: [profiles and models](../profiles.md#plant-model). A vector over names is a list, a table `{ name = number }`,
or one name, which stands for 1 there. A matrix is a list of rows, or a table of rows by name.
"""
_GAINS_HEAD = """# Keys of a gains file

`<observer>.gains.json`, written by `fauio design` and `fauio fit`: one JSON object, floats written so that they read
back to the same bits. Matrices are objects with `shape` and `rows`. Gains are made for one version of a model, by its
hash.
"""


class Words(str):
    """A default that is said in words, no value."""


def profile_page() -> str:
    """Return the page of the keys of profile.toml."""
    minimal = _minimal_profile()
    (observer,) = minimal.observers
    rule = observer.alarms[0]
    top = {
        **dataclasses.asdict(minimal.identity),
        "system": minimal.system,
        "stale_s": minimal.stale_s,
        "mass_kg": minimal.mass_kg,
    }
    isolation = {key: getattr(observer.isolation, key) for key in ("smoothing_s", "tolerance", "gain_penalty")}
    bank = parameters_of(BankRule)
    shared = {key: bank[key] for key in ("smoothing_s", "tolerance", "score_floor", "gain_penalty")}
    alarms = {key: getattr(rule, key) for key in TUNABLE if key != "threshold"}
    parts = [
        _PROFILE_HEAD,
        "## Top level\n",
        _rows(
            [
                ("format", "integer", "1, the version of this format"),
                *_named(Profile, ("name", "vehicle")),
                *_named(Identity),
                *_named(Profile, ("system", "stale_s", "mass_kg")),
            ],
            top,
        ),
        "\n## `[phase]`\n\nSamples are evidence while the vehicle is armed, in the air and settled.\n",
        _rows(_named(GateRule), dataclasses.asdict(minimal.gate)),
        "\n## `[[excuses]]`\n",
        _rows(_named(ExcuseRule), {"for_s": 0.0}),
        "\n## `[observers.OBSERVER]`\n\nThe sections below stand under it.\n",
        _rows(_named(ObserverProfile, ("settle_s",)), {"settle_s": observer.settle_s}),
        "\n## `inputs.NAME`, `outputs.NAME`, `signals.NAME`\n\nWhere a value = scale · field + offset comes from.\n",
        _rows(
            _named(Channel, renamed={"name": "", "path": "field"}, kinds={"field": "str", "where": "Mapping"}),
            _defaults(Channel),
        ),
        "\n## `transform`\n\nIn place of `inputs` and `outputs`: raw `signals`, and what makes samples of them.\n",
        _rows([("kind", "str", _one_of(TRANSFORMS)), *_named(TransformRule, ("rate_hz",))], {}),
        "\nWhat the kind asks for stands beside them. Parameters of `strapdown`, with their defaults "
        f"({', '.join(f'`{key} = {value:g}`' for key, value in DEFAULTS.items())}): "
        f"{parameters_of(Strapdown)['parameters'][1]}\n\n"
        "Parameters of `surfaces` and `drive`: `reference_speed` and `minimum_speed` (m/s, required), of each actuator "
        "`NAME_delay_s` and `NAME_lag_s` (0); of `drive` also `steering_cubic` (0).",
        f"\n## `isolation`\n\n`method`: {_one_of(METHODS)} `independent` has `smoothing_s` alone.\n",
        "Method `bank`:\n",
        _rows(
            [
                *_listed(shared),
                (
                    "hypotheses",
                    "array of tables",
                    f"{bank['hypotheses'][1]} In each: the keys below.",
                ),
                *((key, "number", bank[key][1]) for key in ("jump_s", "usual_score", "level_s")),
                ("washout_s", "table", f"{bank['washouts'][1]} By fault."),
                ("hypotheses.faults", "list", "The faults that may act; the gains are named after them."),
                ("hypotheses.covariance", "matrix", "Healthy covariance of its smoothed residual (p, p)."),
                ("hypotheses.lasting", "matrix", "The same of the mean of that residual over `level_s`."),
                (
                    "hypotheses.edge",
                    "true or false",
                    "Whether it is not compared but watches for edges.",
                ),
            ],
            isolation
            | {
                "hypotheses.edge": False,
                "hypotheses.lasting": Words("`covariance`"),
                "jump_s": 0.03,
                "washout_s": None,
            },
        ),
        "\n## `alarms.CHANNEL`\n\nDefaults are those of `threshold = 1`; `clear` and `critical` grow with it.\n",
        _rows(
            [
                *_named(AlarmRule, TUNABLE),
                ("false_per_100h", "number", "False alarms that the fit expects in 100 hours; its events carry it."),
                ("excluded_per_100h", "number", "How many more its flights exclude, at 95 %; nothing reads it."),
                ("sees", "text", "What it detects, as measured by the fit; nothing reads it."),
            ],
            alarms | dict.fromkeys((*MEASURED, "sees")),
        ),
        "\n## `effectiveness.FAULT`\n",
        _rows(_named(EffectivenessRule), _defaults(EffectivenessRule)),
    ]
    return "\n".join(parts) + "\n"


def model_page() -> str:
    """Return the page of the keys of a model file."""
    overview = inspect.cleandoc(gains.plants.model_file.__doc__ or "").split("\n\n")[1]
    plant = _named(
        Plant,
        renamed={"c": "offset", **dict.fromkeys((*_MODEL_TABLES, "state_errors"), "")},
        kinds={"offset": "vector"},
    )
    nonlinearity = _named(
        Nonlinearity,
        renamed={
            "arguments": "",
            "rows": "arguments",
            "slopes": "slope",
            "ranges": "range",
            "rates": "rate",
            "ahead": "",
        },
        kinds={
            "arguments": "vector by argument",
            "rate": "number by argument",
            **dict.fromkeys(("slope", "range"), "[low, high] by argument"),
        },
    )
    parts = [
        _MODEL_HEAD,
        block(inspect.cleandoc(overview)),
        "\n## Top level\n",
        _rows(plant, _defaults(Plant)),
        "\n## `[[nonlinearity]]`\n",
        _rows(
            [
                *nonlinearity,
                ("into", "vector", "Which states it drives: its column of G."),
                ("inputs", "vector by argument", "Of a sampled model: what inputs add to the arguments."),
                ("faults", "vector by argument", "Of a sampled model: what actuator faults add to the arguments."),
                ("offset", "number by argument", "Of a sampled model: what time adds to the arguments."),
            ],
            {"slope": Words("derived"), "range": Words("everywhere"), "rate": Words("not said")}
            | dict.fromkeys(("inputs", "faults", "offset"), Words("none")),
        ),
        "\n## `[[fault]]`\n\nEither `input` or `into`.\n",
        _rows(_named(Fault, renamed={"column": "into", "ahead": ""}, kinds={"into": "vector"}), _defaults(Fault)),
        "\n## `[[disturbance]]`, `[[noise]]`\n\nUnknown inputs of the states, and of the outputs.\n",
        _rows(
            [
                ("name", "text", "Its name."),
                ("into", "vector", "Which states (disturbance) or outputs (noise) it moves."),
                ("scale", "number", "How large it is."),
            ],
            {"scale": 1.0},
        ),
        "\n## `[error]`\n\n`default` (1), and by state: the error of its estimate that matters.\n",
        "## Free parameters\n\nA model for `fauio fit --vehicle custom` has more tables, and expressions.\n",
        f"`[parameters]`: {prose((Parameter.__doc__ or '').strip())} Keys of each are `start`, `min` and `max`; a "
        "number in place of them is fixed.",
        "\n`[channels.NAME]` says where an input or output comes from, `[phase]` when samples count: both as in "
        "[a profile](profile.md), but flight is not required unless it says so.",
    ]
    return "\n".join(parts) + "\n"


def gains_page() -> str:
    """Return the page of the keys of a gains file."""
    return f"{_GAINS_HEAD}\n{_rows([('format', 'integer', '1, the version of this format'), *_named(Gains)], {})}\n"


def _named(
    described: type,
    keys: Iterable[str] | None = None,
    renamed: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | None = None,
) -> list[tuple[str, str, str]]:
    """Return key, type and description of a class's parameters.

    ``renamed`` gives the keys that stand for parameters of another name, nothing for one that is no key; ``kinds`` the
    types, by key, of those that a file writes in another form.
    """
    documented = parameters_of(described)
    names = ((key, (renamed or {}).get(key, key)) for key in keys or documented)
    return [(name, (kinds or {}).get(name, documented[key][0]), documented[key][1]) for key, name in names if name]


def _one_of(choices: Iterable[str]) -> str:
    return f"One of {', '.join(map(code, choices))}."


def _listed(documented: Mapping[str, tuple[str, str]]) -> list[tuple[str, str, str]]:
    return [(key, *found) for key, found in documented.items()]


def _rows(documented: Iterable[tuple[str, str, str]], defaults: Mapping[str, Any]) -> str:
    """Return a table with one row for neighbours that are described together."""
    rows = []
    for (kind, what), group in itertools.groupby(documented, key=lambda one: one[1:]):
        keys = [key for key, _, _ in group]
        values = {key: _value(defaults.get(key, _NO_DEFAULT)) for key in keys}
        one_value = len(set(values.values())) == 1
        each = ", ".join(f"{code(key)}: {value}" for key, value in values.items() if value)
        rows.append((", ".join(map(code, keys)), _kind(kind), values[keys[0]] if one_value else each, what))
    return table(_HEAD, rows)


def _defaults(described: Any) -> dict[str, Any]:
    """Return the defaults of a dataclass's fields, by the keys that stand for them in files."""
    keys = {"c": "offset", "column": "into"}
    found = {}
    for field in dataclasses.fields(described):
        if field.default is not dataclasses.MISSING:
            found[keys.get(field.name, field.name)] = field.default
        elif field.default_factory is not dataclasses.MISSING:
            found[keys.get(field.name, field.name)] = None
    return found


def _kind(annotation: str) -> str:
    """Return what a type is called in TOML."""
    if annotation.startswith("{"):
        return ", ".join(code(choice) for choice in annotation.strip("{}").split(", "))
    words = {"float": "number", "int": "integer", "str": "text", "bool": "true or false"}
    plain = annotation.removesuffix(" | None")
    if plain.startswith(("tuple", "list")):
        return "list"
    if plain.startswith(("FloatArray", "NDArray")):
        return "matrix"
    return "table" if plain.startswith("Mapping") else words.get(plain, plain)


def _value(value: Any) -> str:
    if value is _NO_DEFAULT:
        return ""
    if isinstance(value, Words):
        return value
    if value is None or value in ((), ""):
        return "none"
    if value == math.inf:
        return "never"
    if isinstance(value, bool):
        return code(str(value).lower())
    if isinstance(value, tuple):
        return code(f"[{', '.join(f'{one:g}' for one in value)}]")
    return code(f"{value:g}") if isinstance(value, float) else code(str(value))


def _minimal_profile() -> Profile:
    """Return the shipped profile read without all that has a default: what is in it then are the defaults."""
    document = tomllib.loads((_EXAMPLE / "profile.toml").read_text(encoding="utf-8"))
    found = document["observers"]["motors"]
    isolation = found["isolation"]
    channels = {
        part: {name: {key: one[key] for key in ("message", "field")} for name, one in found[part].items()}
        for part in ("inputs", "outputs")
    }
    hypotheses = [{key: one[key] for key in ("faults", "covariance")} for one in isolation["hypotheses"]]
    observer = {
        **channels,
        "isolation": {"method": "bank", "score_floor": isolation["score_floor"], "hypotheses": hypotheses},
        "alarms": {"motor1": {"threshold": 1.0}},
    }
    minimal = {key: document[key] for key in ("format", "name", "vehicle")} | {"observers": {"motors": observer}}
    with tempfile.TemporaryDirectory() as folder:
        for file in _EXAMPLE.glob("motors.*"):
            shutil.copy(file, folder)
        (Path(folder) / "profile.toml").write_text(tomli_w.dumps(minimal), encoding="utf-8")
        return read_profile(folder)
