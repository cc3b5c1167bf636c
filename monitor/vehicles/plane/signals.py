"""Which messages hold a plane's deflections and airspeed."""

from collections.abc import Sequence

from adapters.channels import Channel
from adapters.errors import TelemetryError
from monitor.fitting.effect_signals import EFFECT_MESSAGES, EffectSignals, effect_signals
from monitor.fitting.output_functions import MOTOR, Actuator, MixedOutputs
from monitor.fitting.survey import Survey
from monitor.vehicles.base import Preview
from monitor.vehicles.plane.transform import SurfaceInputs

_AIRSPEED_MESSAGE = "VFR_HUD"
AIRSPEED = Channel("airspeed", _AIRSPEED_MESSAGE, ("airspeed",))

# Functions and kinds of outputs as SRV_Channel.h of ArduPilot and CA_SV_CS*_TYPE of PX4 number them; of two ailerons or
# motors the left one.
_ACTUATORS = (
    Actuator("aileron", 1, (4, 24), (15, 1, 2)),
    Actuator("elevator", 2, (19,), (3,), control=1),
    Actuator("throttle", 3, (70, 73), px4=MOTOR, one_way=True, control=4),
    Actuator("rudder", 4, (21,), (4,), control=2),
)
_ELEVONS, _V_TAIL = SurfaceInputs.mixes
_MIXED = (
    MixedOutputs(_ELEVONS, Actuator(_ELEVONS.first, 0, (77,), (5,)), Actuator(_ELEVONS.second, 0, (78,), (6,))),
    MixedOutputs(_V_TAIL, Actuator(_V_TAIL.first, 0, (79,), (7, 13)), Actuator(_V_TAIL.second, 0, (80,), (8, 14))),
)

MESSAGES = EFFECT_MESSAGES | {_AIRSPEED_MESSAGE, "SYS_STATUS"}
"""The last field is whether there is an airspeed sensor."""
_PRESENT, _SENSOR = "onboard_control_sensors_present", 0x10
"""A bit of SYS_STATUS: MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE."""


def plane_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: the outputs that drive surfaces and throttle, and the airspeed.

    Raises
    ------
    TelemetryError
        A required message is missing or comes too seldom, or the outputs are not those of a plane; the text gives the
        reason.
    """
    if not all(survey.counts.get(_AIRSPEED_MESSAGE) for survey in surveys):
        raise TelemetryError(f"no airspeed; record {_AIRSPEED_MESSAGE} at 10 Hz or more")
    return effect_signals(surveys, SurfaceInputs.signals, _ACTUATORS, {"airspeed": AIRSPEED}, _MIXED)


def has_airspeed_sensor(survey: Survey) -> bool:
    """Return whether the vehicle has an airspeed sensor; without one, its airspeed is an estimate from GPS and wind."""
    if survey.onboard:  # PX4 1.14 and later, and before; ArduPilot logs the airspeed of a sensor only
        parameters = survey.parameters
        return parameters.get("SYS_HAS_NUM_ASPD", 1.0) > 0.0 and parameters.get("FW_ARSP_MODE", 0.0) == 0.0
    present = survey.examples.get("SYS_STATUS", {}).get(_PRESENT)
    return not isinstance(present, int) or bool(present & _SENSOR)


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording."""
    signals = plane_signals([survey])
    compared = has_airspeed_sensor(survey) and bool(survey.counts.get("GPS_RAW_INT"))
    watches = (*signals.driven(_ACTUATORS), *["airspeed"] * compared)
    return Preview(watches, signals.channels, signals.rate_hz)
