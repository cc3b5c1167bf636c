"""Design in blocks: the same bound as the worst block, proven for the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapters.errors import ModelError
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.blocks import block_plant, blocks_of, design_blocks
from gains.synthesis.certificate import certify
from gains.synthesis.convex import design_convex


def two_blocks() -> Plant:
    """Return an oscillator with an actuator fault, mixed up with a lag that two sensors measure, one of them faulty."""
    identity, outputs = np.eye(3), np.eye(3)
    return Plant(
        name="two",
        domain="discrete",
        rate_hz=20.0,
        states=("angle", "lag", "speed"),
        inputs=("torque", "heat"),
        outputs=("first", "angle", "second"),
        A=np.array([[0.9, 0.0, 0.05], [0.0, 0.8, 0.0], [-0.1, 0.0, 0.9]]),
        B=np.array([[0.0, 0.0], [0.0, 0.2], [0.05, 0.0]]),
        C=np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        faults=(
            Fault("bias", "sensor", outputs[:, 2]),
            Fault("push", "actuator", np.array([0.0, 0.0, 0.05])),
        ),
        disturbances=tuple(Disturbance(f"w{i}", identity[:, i], 0.01) for i in range(3)),
        noises=tuple(Noise(f"v{i}", outputs[:, i], 0.01) for i in range(3)),
    )


def test_blocks_are_what_hangs_together() -> None:
    blocks = blocks_of(two_blocks())
    assert [(block.states, block.outputs) for block in blocks] == [((0, 2), (1,)), ((1,), (0, 2))]
    assert [(block.sensor_faults, block.actuator_faults) for block in blocks] == [((), (0,)), ((0,), ())]


def test_the_whole_has_the_bound_of_its_worst_block_and_a_certificate() -> None:
    plant = two_blocks()
    design = design_blocks(plant)
    parts = [design_convex(block_plant(plant, block)) for block in blocks_of(plant)]
    assert design.mu == max(part.mu for part in parts)
    assert certify(plant, design).holds
    assert design.sqrt_mu == pytest.approx(design_convex(plant).sqrt_mu, rel=0.05)


def test_a_shared_noise_ties_blocks_together() -> None:
    plant = two_blocks()
    shared = replace(plant, noises=(Noise("hum", np.array([0.0, 0.1, 0.1]), 1.0),))
    assert len(blocks_of(shared)) == 1


def test_a_block_without_a_fault_is_named() -> None:
    plant = two_blocks()
    with pytest.raises(ModelError, match="no fault concerns lag, first, second"):
        design_blocks(replace(plant, faults=plant.faults[1:]))


def test_continuous_plants_are_refused() -> None:
    with pytest.raises(ModelError, match="only discrete"):
        blocks_of(replace(two_blocks(), domain="continuous", rate_hz=None))
