"""Simulated quadrotors whose rates a controller holds, with motor lag, delay, coloured gusts and exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gains.identification.segment import Segment

FloatArray = NDArray[np.float64]

MIXER = np.array([[-1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, 1.0], [1.0, 1.0, -1.0, 1.0], [-1.0, -1.0, -1.0, 1.0]])
"""Share of each control (roll, pitch, yaw, thrust) in the command of each motor of a quad x."""
HOVER = 0.5
STEP_S, LOOP = 0.002, 2
"""Step of the simulation, and steps of the simulation per step of the controller."""


@dataclass(frozen=True, slots=True)
class Quad:
    """The vehicle; rates in rad/s, effects of a motor's whole thrust in rad/s^2."""

    lag_s: float = 0.03
    delay_s: float = 0.02
    square: float = 0.4
    drag: float = 0.0  # share of thrust's square in the drag, which turns about yaw
    effect: tuple[float, float, float] = (15.0, 15.0, 2.0)
    damping: tuple[float, float, float] = (1.0, 1.0, 0.6)
    gust: tuple[float, float, float] = (1.0, 1.0, 0.3)
    gust_s: float = 0.7
    noise: float = 1e-3

    def B(self) -> FloatArray:
        """Return the acceleration that each motor's thrust gives (3, 4)."""
        return np.array(self.effect)[:, None] * MIXER[:, :3].T

    def effects(self) -> FloatArray:
        """Return the acceleration for a unit of each motor's command at hover (3, 4)."""
        return self.B() * (1.0 - self.square + 2.0 * self.square * HOVER)


@cache
def closed_loop(
    quad: Quad, rate_hz: float, seconds: float, flights: int, seed: int, brisk: float = 1.0, turning: float = 1.0
) -> list[Segment]:
    """Return flights with random sticks, whose rates a controller with 250 steps a second holds.

    ``brisk`` scales what the sticks ask for; 0 is hovering. ``turning`` does so for yaw.
    """
    rng = np.random.default_rng(seed)
    B, damping, gusts = quad.B(), np.array(quad.damping), np.array(quad.gust)
    gain = np.array([0.48, 0.48, 0.52]) / np.array([15.0, 15.0, 2.0]) * np.array([3.75, 3.75, 0.5])
    y, gust, wanted, mean, slow = (np.zeros((flights, 3)) for _ in range(5))
    before = np.zeros((flights, 3))
    lift = np.zeros(flights)
    u = np.full((flights, 4), HOVER)
    on_the_way = [u] * round(quad.delay_s / STEP_S)
    thrust = (1.0 - quad.square) * u + quad.square * u**2
    turn = thrust + quad.drag * (thrust**2 - thrust)
    keep, keep_lag = np.exp(-STEP_S / quad.gust_s), np.exp(-STEP_S / quad.lag_s)
    commands, rates = [], []
    every = round(1.0 / rate_hz / STEP_S)
    for k in range(round(seconds / STEP_S)):
        gust = keep * gust + np.sqrt(1.0 - keep**2) * gusts * rng.normal(size=(flights, 3))
        measured = y + quad.noise * rng.normal(size=(flights, 3))
        if k % LOOP == 0:
            moved = rng.random(flights) < STEP_S * LOOP / 0.3
            wanted = np.where(moved[:, None], brisk * rng.normal(size=(flights, 3)) * (0.5, 0.5, 0.4 * turning), wanted)
            lift = np.where(moved, 0.04 * min(brisk, 1.0) * rng.normal(size=flights), lift)
            mean = within(mean + (wanted - measured) * STEP_S * LOOP, -1.0, 1.0)
            slow = slow + 0.15 * ((before - measured) / (STEP_S * LOOP) - slow)
            before = measured
            controls = within(gain * (wanted - measured + 0.5 * mean + 0.03 * slow), -0.2, 0.2)
            u = within(HOVER + lift[:, None] + controls @ MIXER[:, :3].T, 0.02, 1.0)
        if k % every == 0:
            commands.append(u)
            rates.append(measured)
        on_the_way.append(u)
        acting = on_the_way.pop(0)
        last, turned = thrust, turn
        thrust = thrust + ((1.0 - quad.square) * acting + quad.square * acting**2 - thrust) * (1.0 - keep_lag)
        turn = thrust + quad.drag * (thrust**2 - thrust)
        torque = 0.5 * np.hstack([(last + thrust) @ B[:2].T, (turned + turn) @ B[2:].T])
        y = y + STEP_S * (torque - damping * y + gust)
    settled = round(2.0 * rate_hz)
    return [Segment(np.array(commands)[settled:, i], np.array(rates)[settled:, i]) for i in range(flights)]


def within(values: FloatArray, least: float, most: float) -> FloatArray:
    """Return values within limits; of few values ``np.clip`` takes five times as long."""
    return np.minimum(np.maximum(values, least), most)
