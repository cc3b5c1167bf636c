"""What the tests of gains share: plants (printed, random, multirotor) and random expressions."""

from dataclasses import replace

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from gains.identification.simulation import Dynamics, compile_vectorised
from gains.plants.expression import Apply, Argument, Node, Number, binary, parse_expression
from gains.plants.plant import Disturbance, Fault, FloatArray, Noise, Nonlinearity, Plant
from gains.synthesis.certificate import Certificate, certify
from gains.synthesis.design import Design

DESIGNS = settings().max_examples // 4
"""Examples of an invariant whose every example designs observers."""
PRINTED = {
    "A": [[0, 1, 0, 0], [-48.6, -1.25, 48.6, 0], [0, 0, 0, 1], [19.5, 0, -19.5, 0]],
    "B": [[0], [21.6], [0], [0]],
    "G": [[0], [0], [0], [-3.33]],
    "C": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]],
    "D_f": [[1], [0], [0]],
    "E_1": [[0], [0], [0], [1]],
    "D_1": [[0.1], [-0.02], [0]],
}


def sine(row: FloatArray, slopes: tuple[float, float] = (-1.0, 1.0)) -> Nonlinearity:
    """Return sin(row x)."""
    return Nonlinearity("sin(v)", ("v",), np.atleast_2d(row), np.array([slopes]), np.array([[-np.inf, np.inf]]))


def random_plant(seed: int, actuators: int, sensors: int, nonlinear: int = 0, decades: float = 0.0) -> Plant:
    """Return a stable discrete plant with random matrices; its units spread over 10^+-decades."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(max(1, actuators), 5))
    p = int(rng.integers(actuators + sensors, 5)) if actuators + sensors < 5 else 5
    s = int(rng.integers(0, 3))
    x, y = 10.0 ** rng.uniform(-decades, decades, n), 10.0 ** rng.uniform(-decades, decades, p)
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.97) / np.max(np.abs(np.linalg.eigvals(A)))

    def sizes(count: int, low: float = -1.0, high: float = 1.0) -> list[float]:
        return list(10.0 ** rng.uniform(low, high, count))

    faults = [
        Fault(f"actuator{i}", "actuator", x * rng.normal(size=n), rate=rate, error=error)
        for i, (rate, error) in enumerate(zip(sizes(actuators), sizes(actuators), strict=True))
    ]
    faults += [Fault(f"sensor{i}", "sensor", y * np.eye(p)[i], error=sizes(1)[0]) for i in range(sensors)]
    return Plant(
        name="random",
        domain="discrete",
        rate_hz=10.0,
        states=tuple(f"x{i}" for i in range(n)),
        inputs=tuple(f"u{i}" for i in range(s)),
        outputs=tuple(f"y{i}" for i in range(p)),
        A=x[:, None] * A / x,
        B=x[:, None] * rng.normal(size=(n, s)),
        C=y[:, None] * rng.normal(size=(p, n)) / x,
        c=x * rng.normal(size=n),
        G=x[:, None] * rng.normal(size=(n, nonlinear)) * 0.1,
        nonlinearities=tuple(sine(rng.normal(size=n) / n / x) for _ in range(nonlinear)),
        faults=tuple(faults),
        disturbances=tuple(
            Disturbance(f"d{i}", x * rng.normal(size=n), scale) for i, scale in enumerate(sizes(2, -2.0, 0.0))
        ),
        noises=tuple(Noise(f"w{i}", y * rng.normal(size=p), scale) for i, scale in enumerate(sizes(2, -2.0, 0.0))),
        state_errors=x * sizes(n),
        taps=(0.25, 0.5, 0.25) if s else (1.0,),
        curves=tuple((1.0, 0.2 * i) for i in range(s)),
    )


def continuous_plant(
    seed: int, actuators: int, sensors: int, nonlinear: int = 0, decades: float = 0.0, speed: float = 1.0
) -> Plant:
    """Return a stable continuous plant with random matrices whose time constants are about 1 / speed."""
    plant = random_plant(seed, actuators, sensors, nonlinear, decades)
    return replace(
        plant,
        domain="continuous",
        rate_hz=None,
        taps=(1.0,),
        A=(plant.A - np.eye(len(plant.A))) * speed,
        B=plant.B * speed,
        G=plant.G * speed,
        c=plant.c * speed,
        faults=tuple(replace(f, column=f.column * speed) if f.kind == "actuator" else f for f in plant.faults),
        disturbances=tuple(replace(w, column=w.column * speed) for w in plant.disturbances),
    )


def multirotor() -> Plant:
    """Return a multirotor as identified from flights, in very different units (rad/s per step, m/s^2)."""
    names, motors = ("roll_rate", "pitch_rate", "yaw_rate", "acceleration"), ("motor1", "motor2", "motor3", "motor4")
    B = np.array(
        [
            [-1.55107001, 1.55093125, 0.00465484, -0.00483601],
            [-0.00860194, 0.00898542, 1.52739956, -1.52801827],
            [0.05034375, 0.0237968, -0.03074904, -0.0433478],
            [-2.35599291, -2.35599291, -2.35599291, -2.35599291],
        ]
    )
    size = np.array([1e-3, 1e-3, 1e-3, 0.5])
    return Plant(
        name="multirotor",
        domain="discrete",
        rate_hz=100.0,
        states=names,
        inputs=motors,
        outputs=names,
        A=np.diag([0.9766, 0.9771, 0.9805, 0.0]),
        B=B,
        C=np.eye(4),
        faults=tuple(Fault(motor, "actuator", rate=0.5, error=0.01, input=motor) for motor in motors),
        disturbances=tuple(Disturbance(f"d_{name}", np.eye(4)[i], size[i]) for i, name in enumerate(names)),
        noises=tuple(Noise(f"n_{name}", np.eye(4)[i], size[i]) for i, name in enumerate(names)),
    )


def hexacopter() -> Plant:
    """Return a regular hexacopter: six motors, three rates and the vertical acceleration."""
    angles, motors = np.deg2rad([30.0, 90, 150, 210, 270, 330]), tuple(f"motor{i}" for i in range(1, 7))
    plant = multirotor()
    return replace(
        plant,
        name="hexacopter",
        inputs=motors,
        B=np.array([-1.5 * np.sin(angles), 1.5 * np.cos(angles), [0.05, -0.05] * 3, [-2.0] * 6]),
        faults=tuple(Fault(motor, "actuator", rate=0.5, error=0.01, input=motor) for motor in motors),
        curves=(),
    )


def with_rates(plant: Plant, rate: float) -> Plant:
    """Return the plant with another rate of every actuator fault."""
    return replace(plant, faults=tuple(replace(fault, rate=rate) for fault in plant.faults))


def trees() -> st.SearchStrategy[Node]:
    """Return random expressions of two arguments."""
    numbers = st.floats(-3, 3).map(lambda x: Number(round(x, 2)))
    leaves = st.one_of(numbers, st.integers(0, 1).map(Argument))

    def grow(children: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
        powers = st.builds(lambda base, n: binary("**", base, Number(float(n))), children, st.integers(1, 3))
        sums = st.builds(binary, st.sampled_from("+-*/"), children, children)
        calls = st.builds(Apply, st.sampled_from(["sin", "cos", "tanh", "atan", "exp", "sqrt", "log"]), children)
        return st.one_of(sums, powers, calls)

    return st.recursive(leaves, grow, max_leaves=6)


def integrator_with_drift() -> Plant:
    """Return a position that integrates a velocity, its only sensor attacked: the attack looks like drift."""
    return Plant(
        name="drift",
        domain="discrete",
        rate_hz=10.0,
        states=("position", "velocity"),
        inputs=(),
        outputs=("gps", "speedometer"),
        A=np.array([[1.0, 0.1], [0.0, 0.9]]),
        B=np.zeros((2, 0)),
        C=np.eye(2),
        faults=(Fault("gps_offset", "sensor", np.array([1.0, 0.0])),),
        disturbances=(Disturbance("push", np.array([0.0, 1.0]), 0.1),),
        noises=(Noise("jitter", np.array([1.0, 1.0]), 0.1),),
    )


def flying_multirotor(rate_hz: float | None = None) -> Plant:
    """Return a multirotor's rigid body: 12 states, 4 motors, thrust that tilts with roll and pitch, and drag.

    The slopes are those of sin within 0.7 rad and of quadratic drag within 10 m/s.
    """
    position, attitude = ("north", "east", "down"), ("roll", "pitch", "yaw")
    velocity = ("v_north", "v_east", "v_down")
    states = (*position, *attitude, *velocity, "p", "q", "r")
    motors = tuple(f"motor{i}" for i in range(1, 5))
    A, G, unit = np.zeros((12, 12)), np.zeros((12, 3)), np.eye(12)
    A[0:3, 6:9] = A[3:6, 9:12] = np.eye(3)
    A[6:8, 6:8], A[9:12, 9:12] = -0.2 * np.eye(2), np.diag([-2.3, -2.3, -2.0])
    G[7, 0], G[6, 1], G[8, 2] = 9.81, -9.81, -1.0
    B = np.zeros((12, 4))
    B[8] = -5.0
    B[9:] = [[-40.0, 40.0, 40.0, -40.0], [40.0, -40.0, 40.0, -40.0], [4.0, 4.0, -4.0, -4.0]]
    tilt, drag = (float(np.cos(0.7)), 1.0), (0.0, 0.4)
    noise = np.repeat([0.5, 0.01, 0.1, 0.02], 3)
    return Plant(
        name="flying_multirotor",
        domain="continuous",
        rate_hz=rate_hz,
        states=states,
        inputs=motors,
        outputs=states,
        A=A,
        B=B,
        C=np.eye(12),
        G=G,
        nonlinearities=(
            sine(unit[3], tilt),
            sine(unit[4], tilt),
            Nonlinearity("0.02*v*abs(v)", ("v",), unit[8:9], np.array([drag]), np.array([[-np.inf, np.inf]])),
        ),
        faults=tuple(Fault(motor, "actuator", rate=0.5, error=0.05, input=motor) for motor in motors),
        disturbances=tuple(Disturbance(f"d_{states[i]}", unit[i], 0.5 if i < 9 else 1.0) for i in range(6, 12)),
        noises=tuple(Noise(f"n_{name}", unit[i], noise[i]) for i, name in enumerate(states)),
        state_errors=np.repeat([0.5, 0.02, 0.2, 0.1], 3),
    )


def dynamics_of(plant: Plant) -> Dynamics:
    """Return the equations of a plant; its taps are not applied: delay the inputs beforehand."""
    curves = np.zeros((len(plant.inputs), max((len(curve) for curve in plant.curves), default=1)))
    for row, curve in zip(curves, plant.curves, strict=True):
        row[: len(curve)] = curve
    return Dynamics(
        rate_hz=plant.rate_hz,
        A=plant.A,
        B=plant.B,
        C=plant.C,
        c=plant.c,
        G=plant.G,
        rows=tuple(g.rows for g in plant.nonlinearities),
        functions=tuple(compile_vectorised(parse_expression(g.expression, g.arguments)) for g in plant.nonlinearities),
        parameters=np.zeros(0),
        curves=curves,
    )


def rmse(error: FloatArray) -> float:
    """Return the root of the mean square of errors."""
    return float(np.sqrt(np.mean(error**2)))


def assert_proven(plant: Plant, design: Design) -> Certificate:
    """Return the certificate of a design, which has to hold and to be stable."""
    certificate = certify(plant, design)
    assert certificate.holds
    assert certificate.margin > 0.0
    assert certificate.norm <= design.sqrt_mu
    assert certificate.poles_max < (0.0 if design.rate_hz is None else 1.0)
    return certificate
