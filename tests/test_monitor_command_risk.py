"""Commands that can bring a vehicle down are told from those that cannot."""

import pytest

from monitor.alarms.command_watch import command_risk


@pytest.mark.parametrize(
    ("name", "values", "risk"),
    [
        ("400", (0.0, 21196.0), "disarms"),
        ("400", (1.0,), None),
        ("246", (1.0,), "reboots the autopilot"),
        ("185", (1.0,), "triggers termination"),
        ("176", (1.0, 4.0), "changes the mode"),
        ("SET_MODE", (81, 4), "changes the mode"),
        ("512", (0.0,), None),
        ("PARAM_SET", ("FENCE_ENABLE", 0.0), "sets FENCE_ENABLE"),
        ("PARAM_SET", ("COM_DL_LOSS_T", 999.0), "sets COM_DL_LOSS_T"),
        ("PARAM_SET", ("LOG_BITMASK", 0.0), None),
        ("PARAM_SET", ("ATC_RAT_RLL_P", 9.0), "sets ATC_RAT_RLL_P"),
        ("MISSION_COUNT", (3,), "rewrites the mission"),
        ("MISSION_COUNT", (3, 1, 0), "rewrites the fence"),
        ("MISSION_CLEAR_ALL", (1,), "rewrites the fence"),
        ("MISSION_CLEAR_ALL", (255,), "rewrites the mission"),
        ("207", (0.0,), "switches the fence off"),
        ("207", (1.0,), None),
        ("208", (2.0,), "releases the parachute"),
        ("179", (1.0,), "moves the home position"),
        ("300", (0.0,), "starts the mission"),
        ("PARAM_EXT_SET", ("FENCE_ENABLE", "0", 1), "sets FENCE_ENABLE"),
        ("SETUP_SIGNING", (0,), "changes the signing key"),
        ("MISSION_REQUEST_LIST", (), None),
    ],
)
def test_what_a_command_does_in_flight(name: str, values: tuple[float | str, ...], risk: str | None) -> None:
    assert command_risk(name, values) == risk
