"""The observers for comparison, by name, and their figures: reconstructions and a Kalman filter."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gains.plants.plant import Plant
from gains.published.chen2006 import design_chen2006
from gains.published.error_system import error_norm
from gains.published.gao2016 import design_gao2016
from gains.published.gao2022 import design_gao2022
from gains.published.kalman import design_ekf
from gains.published.zhang2008 import design_zhang2008
from gains.synthesis.continuous_observer import ContinuousObserver, compile_continuous
from gains.synthesis.design import design_figures
from gains.synthesis.gains_file import Gains

_DESIGNS: dict[str, Callable[[Plant], ContinuousObserver]] = {
    "gao2022": design_gao2022,
    "gao2016": design_gao2016,
    "chen2006": design_chen2006,
    "zhang2008": design_zhang2008,
}


def design_baseline(plant: Plant, method: str, rate_hz: float | None) -> tuple[Gains | None, dict[str, Any]]:
    """Design a baseline by its name; return compiled gains, if there is a rate, and the report of the command line.

    The reconstructions need a continuous model; the filter takes a discrete model's own rate. The report's certificate
    holds if the true norm of these gains is within the bound that their inequality reports; it does not hold for
    methods without a bound.

    Raises
    ------
    ModelError
        The model is discrete and the method is for continuous models only, or the model cannot be sampled.
    InfeasibleError
        The method cannot estimate such faults, or its inequality has no solution; the message says why.
    InaccurateError
        The solver stopped short, or the norm of the gains does not confirm the bound.
    """
    started = time.perf_counter()
    if method == "ekf":
        gains = design_ekf(plant, rate_hz)
        return gains, _filter_figures(gains, time.perf_counter() - started)
    observer = _DESIGNS[method](plant)
    total_s = time.perf_counter() - started
    norm = error_norm(plant, observer, noise_path="all", inputs="disturbances" if method == "gao2016" else "all")
    bound = observer.sqrt_mu
    report = design_figures(
        plant.name,
        method,
        "continuous",
        rate_hz,
        sqrt_mu=bound,
        norm=norm.value,
        norm_hz=norm.hz if np.isfinite(norm.hz) else None,
        poles_max_re=norm.pole_max,
        gain_max_abs=float(np.max(np.abs(observer.B_y))),
        certificate={
            "holds": bound is not None and norm.confirms(bound),
            "margin": None if bound is None else bound - norm.value,
        },
        solve_s=observer.solve_s,
        total_s=total_s,
        notes=["a reconstruction: the original text could not be had", *observer.notes],
    )
    return None if rate_hz is None else compile_continuous(observer, rate_hz, report), report


def _filter_figures(gains: Gains, total_s: float) -> dict[str, Any]:
    states = len(gains.initial_matrix)
    return design_figures(
        gains.model,
        "ekf",
        "discrete",
        gains.rate_hz,
        poles_max_abs=float(np.max(np.abs(np.linalg.eigvals(gains.step_matrix[:states, :states])))),
        gain_max_abs=float(np.max(np.abs(gains.step_matrix))),
        solve_s=0.0,
        total_s=total_s,
        notes=["a Kalman filter proves no bound; its poles are those of the linear part"],
    )
