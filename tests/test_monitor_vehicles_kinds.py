"""Every kind of vehicle is complete, and named wherever people choose one."""

from pathlib import Path

import pytest

from monitor.vehicles.base import VehicleKind, likely_kinds, load
from monitor.vehicles.kinds import KINDS, TRANSFORMS, fit_messages, kind_named

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_what_a_kind_names_is_in_its_folder(kind: VehicleKind) -> None:
    references = [kind.fit, kind.preview, kind.messages, *kind.transforms.values()]
    assert all(load(reference) is not None for reference in references if reference)
    assert all(reference.startswith(f"monitor.vehicles.{kind.name}.") for reference in references if reference)
    assert kind_named(kind.name) is kind


def test_every_kind_has_a_folder_and_every_folder_is_a_kind() -> None:
    folders = {path.parent.name for path in (ROOT / "monitor/vehicles").glob("*/__init__.py")}
    assert folders == {kind.name for kind in KINDS}


def test_the_readme_names_every_kind() -> None:
    readme = (ROOT / "README.md").read_text()
    assert [kind.name for kind in KINDS if f"`{kind.name}`" not in readme] == []


@pytest.mark.parametrize(
    ("said", "names"),
    [
        ("quadrotor", ["multirotor"]),
        ("fixed_wing", ["plane"]),
        ("fixed wing", ["plane"]),
        ("ground_rover", ["rover"]),
        ("vtol_fixedrotor", ["plane", "multirotor"]),
        ("gcs", []),
    ],
)
def test_the_autopilot_says_which_kind_is_likely(said: str, names: list[str]) -> None:
    assert [kind.name for kind in likely_kinds(KINDS, said)] == names


def test_transforms_and_messages_of_all_kinds_are_known() -> None:
    known = {"surfaces", "airspeed", "drive", "strapdown", "esc", "vibration", "imbalance", "battery"}
    assert set(TRANSFORMS) == known
    assert all(callable(load(place)) for place in TRANSFORMS.values())
    assert {"ATTITUDE", "SERVO_OUTPUT_RAW", "GPS_RAW_INT", "VFR_HUD", "HEARTBEAT"} <= fit_messages()
