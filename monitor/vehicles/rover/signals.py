"""Which messages hold a rover's steering, throttle and velocity."""

from collections.abc import Sequence
from dataclasses import replace

from adapters.channels import Channel
from monitor.fitting.effect_signals import EFFECT_MESSAGES, EffectSignals, effect_signals
from monitor.fitting.output_functions import DIFFERENTIAL, MOTOR, SERVO, Actuator, MixedOutputs
from monitor.fitting.survey import Survey, required
from monitor.vehicles.base import Preview
from monitor.vehicles.rover.transform import DriveInputs

# Messages of the velocity over ground and the m/s of one of their units, the preferred message first.
_VELOCITIES = {"LOCAL_POSITION_NED": 1.0, "GLOBAL_POSITION_INT": 0.01}

# Functions of outputs as SRV_Channel.h of ArduPilot and PX4's rovers number them.
_ACTUATORS = (
    Actuator("steering", 1, (26,), px4=SERVO, control=2),
    Actuator("throttle", 3, (70,), px4=MOTOR, control=4),
)
_SIDES = MixedOutputs(
    DriveInputs.mixes[0],
    Actuator(DriveInputs.mixes[0].first, 0, (73,), px4=MOTOR + 1),
    Actuator(DriveInputs.mixes[0].second, 0, (74,), px4=MOTOR),
)

MESSAGES = EFFECT_MESSAGES | _VELOCITIES.keys()


def rover_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: the outputs that drive steering and throttle, and the velocity over ground.

    Raises
    ------
    TelemetryError
        A required message is missing or comes too seldom, or the outputs are not those of a rover; the text gives the
        reason.
    """
    message = required(surveys, _VELOCITIES, "velocity", "10 Hz")
    velocities = {
        name: Channel(name, message, (field,), scale=_VELOCITIES[message])
        for name, field in (("velocity_north", "vx"), ("velocity_east", "vy"))
    }
    signals = effect_signals(surveys, DriveInputs.signals, _ACTUATORS, velocities, [_SIDES])
    if "sides" not in signals.parameters and not any(s.parameters.get("CA_AIRFRAME") == DIFFERENTIAL for s in surveys):
        return signals
    return replace(signals, parameters={**signals.parameters, "differential": 1.0})


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording."""
    signals = rover_signals([survey])
    return Preview(signals.driven(_ACTUATORS), signals.channels, signals.rate_hz)
