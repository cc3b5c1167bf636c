"""Modes have the names that pilots know, each vehicle its own."""

import pytest

from adapters.mavlink.heartbeat import ARDUPILOT, PX4, mode_name


@pytest.mark.parametrize(
    ("autopilot", "kind", "base", "custom", "name"),
    [
        (ARDUPILOT, 2, 0, 5, "LOITER"),
        (ARDUPILOT, 1, 0, 5, "FBWA"),
        (ARDUPILOT, 10, 0, 4, "HOLD"),
        (PX4, 2, 209, 3 << 16, "POSCTL"),
        (ARDUPILOT, 2, 0, 999, ""),
        (8, 2, 0, 5, ""),
    ],
)
def test_a_mode_has_its_vehicle_s_name(autopilot: int, kind: int, base: int, custom: int, name: str) -> None:
    assert mode_name(autopilot, kind, base, custom) == name
