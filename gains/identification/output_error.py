"""Identification of a plant with free parameters from noisy recordings, and the uncertainty of the result.

1. Simulation over windows with free initial states (output error, multiple shooting): unbiased under measurement noise.
   The transport delay of the inputs is the whole number of samples that fits best.
2. The simulation's residuals are attributed to disturbance and noise by maximum likelihood, which gives a Kalman gain.
3. One-step prediction errors with that gain (prediction-error method): unbiased under disturbances too, and efficient.
   Steps 2 and 3 are taken twice.

Standard errors come from the Jacobian, and are enlarged if the errors of whole windows vary more than white ones would.
Source: Ljung, System Identification, 2nd ed. 1999, chapters 7, 9 and 16.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapters.errors import ModelError
from gains.identification.excitation import ExcitationVerdict, excitation_verdicts
from gains.identification.free_model import FreeModel
from gains.identification.noise_scales import NoiseScales, fit_noise_scales
from gains.identification.residuals import ResidualStatistics, residual_statistics
from gains.identification.segment import Segment
from gains.identification.shooting import Shooting, Windows, cut_windows
from gains.identification.simulation import Hold, linearised
from gains.plants.discretise import discretise
from gains.plants.plant import Disturbance, FloatArray, Noise, Plant, on_each

_WINDOW_S = 2.0
"""Length of a window, s. Longer ones show slow dynamics, in shorter ones disturbances move the simulation less.
Measured on the turret of the tests: 1 s and 4 s move the parameters by less than half a standard error, except for one
of sixteen (1.3)."""
_LONGEST_DELAY_S = 0.2
"""Largest delay tried, s: telemetry radios and filters add up to less."""

_LENGTHS = (20, 200)
"""Fewest and most samples of a window: fewer show no dynamics beside the free initial state, more cost memory."""
_MOST_WINDOWS = 150
"""Largest number of windows, five minutes of data: it bounds the time of a fit. Standard errors shrink with the root of
the number of windows."""
_COARSE_WINDOWS = 20
"""Number of windows for the search of the delay alone. Measured on the turret of the tests: 5 and 40 find the same."""
_FEWEST_WINDOWS = 6
"""Fewest windows: with fewer the variation between windows, from which the standard errors follow, is not known."""
_ROUNDS = 2
"""Number of estimates of noise and parameters in turn. Measured on the turret of the tests: one gives parameters and
noise within .5 % of two, and three change nothing."""
_DELAY_GAIN = 0.01
"""Smallest gain in the logarithm of each output's error for which a delay or a hold is kept: 1 % of the error. Measured
on the turret of the tests: .001 and .1 choose the same."""
# Least relative error: samples do not show the inputs between them.
_LEAST_ERROR = 1e-3
# Share of the information below which it is rounding of the sensitivities.
_UNSEEN = 1e-11
_COARSE_EVALUATIONS = 8
# Smallest gain, in squared standard errors, for which a neighbouring delay is chosen.
_SWITCH = 6.0
_EVALUATIONS = 30


@dataclass(frozen=True, slots=True, eq=False)
class FittedData:
    """Recorded windows and the fitted model's predictions of them."""

    # outputs (W, T, p); the simulation uses measurements for its initial state only
    measured: FloatArray
    simulated: FloatArray
    innovations: FloatArray  # one-step prediction errors (W, T, p)
    states: FloatArray  # predicted states (W, T, n)
    u: FloatArray  # inputs, delayed (W, T, s)
    # explained share of each output's variance by the simulation, and of its change from sample to sample by the
    # one-step prediction (p,)
    simulated_share: FloatArray
    predicted_share: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OutputErrorFit:
    """The result of identifying a model with free parameters from recordings."""

    model: FreeModel
    rate_hz: float  # samples per second of the recordings
    # estimates (k,) and their covariance (k, k)
    theta: FloatArray
    covariance: FloatArray
    verdicts: tuple[ExcitationVerdict, ...]  # whether the recordings determine each parameter
    delay: int  # transport delay of the inputs, samples
    hold: Hold  # whether inputs fit better as ramps between samples or as steps
    signals: Plant  # the plant at theta with the fitted disturbances and noises at their most likely scales
    noise: NoiseScales  # those scales with the Kalman gain
    # the windows of the fit, and windows kept back
    training: FittedData
    validation: FittedData
    residuals: tuple[ResidualStatistics, ...]  # statistics of the validation's innovations, one per output


def identify(
    model: FreeModel, training: Sequence[Segment], validation: Sequence[Segment], rate_hz: float
) -> OutputErrorFit:
    """Estimate a model's free parameters, its delay and its noise.

    For a model without free parameters only delay and noise are estimated. The samples to fit on, and the
    ``validation`` that judges the fit, are healthy; windows keep to 20 to 200 samples.

    Raises
    ------
    ModelError
        There are too few samples, or the model diverges at its start values.
    """
    if model.example.taps != (1.0,):
        raise ModelError(f"{model.path}: 'taps': leave them out; the delay is estimated")
    if model.example.bends.size:
        raise ModelError(f"{model.path}: 'bends': leave them out; they are for models without free parameters")
    length = int(np.clip(round(_WINDOW_S * rate_hz), *_LENGTHS))
    longest = round(_LONGEST_DELAY_S * rate_hz) if model.example.inputs else 0
    for segments in (training, validation):
        _check_longest(model, segments, rate_hz, length + longest)
    work = _Work(model, training, rate_hz, length, longest)
    delay, hold, theta, size = work.delay_and_hold()
    windows = work.windows(delay, _MOST_WINDOWS)
    if len(windows.y) < _FEWEST_WINDOWS:
        raise ModelError(
            f"{model.path}: only {len(windows.y) * length / rate_hz:.0f} s of healthy samples to fit on; "
            f"at least {_FEWEST_WINDOWS * length / rate_hz:.0f} s are needed"
        )
    # 1. Simulation, K = 0; then again with each output in units of its error in the first.
    free = np.zeros((len(model.example.states), len(model.example.outputs)))
    theta, shooting = work.fit(theta, windows, hold, free, np.diag(1.0 / size))
    size = np.maximum(_rms(shooting.errors(theta)), 1e-9)
    theta, shooting = work.fit(theta, windows, hold, free, np.diag(1.0 / size), shooting.x)
    for _ in range(_ROUNDS):
        # 2. Disturbance and noise: gain K and covariance S of the innovations. With L L' = S^-1 they have size one.
        simulation = work.shooting(windows, hold, free, np.diag(1.0 / size), shooting.x)
        errors = simulation.errors(theta)
        noise = _noise(_with_signals(model.plant(theta)), simulation.states(theta), errors, rate_hz)
        weight = np.linalg.cholesky(np.linalg.inv(noise.S))
        # 3. One-step prediction with that gain, at the delays next to that of the simulation.
        delay, hold, theta, shooting = work.refined(delay, hold, theta, noise.K, weight)
        windows = work.windows(delay, _MOST_WINDOWS)
    # The quality of the fit, on its own windows and on windows kept back.
    covariance = _covariance(shooting, theta, len(windows.y))
    fitted = work.fitted(theta, hold, windows, noise)
    kept_back = work.fitted(theta, hold, cut_windows(validation, length, delay, longest, _MOST_WINDOWS), noise)
    names = (*model.example.states, *model.example.inputs)
    moved = np.concatenate([fitted.states.std(axis=(0, 1)), fitted.u.std(axis=(0, 1))])
    movement = dict(zip(names, moved.tolist(), strict=True))
    return OutputErrorFit(
        model=model,
        rate_hz=rate_hz,
        theta=theta,
        covariance=covariance,
        verdicts=excitation_verdicts(model, theta, covariance, movement),
        delay=delay,
        hold=hold,
        signals=_with_scales(_with_signals(model.plant(theta)), noise),
        noise=noise,
        training=fitted,
        validation=kept_back,
        residuals=residual_statistics(model.example.outputs, list(kept_back.innovations)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Work:
    """The data and the model of all stages."""

    model: FreeModel
    segments: Sequence[Segment]
    rate_hz: float
    length: int
    longest_delay: int

    def windows(self, delay: int, most: int) -> Windows:
        return cut_windows(self.segments, self.length, delay, self.longest_delay, most)

    def shooting(
        self, windows: Windows, hold: Hold, K: FloatArray, weight: FloatArray, x: FloatArray | None = None
    ) -> Shooting:
        sizes = np.array([parameter.size for parameter in self.model.parameters])
        return Shooting(self.model.dynamics, sizes, windows, self.rate_hz, hold, K, weight, x)

    def fit(
        self,
        theta: FloatArray,
        windows: Windows,
        hold: Hold,
        K: FloatArray,
        weight: FloatArray,
        x: FloatArray | None = None,
        evaluations: int = _EVALUATIONS,
    ) -> tuple[FloatArray, Shooting]:
        """Return the parameters with the least weighted squared errors, and the problem they solve."""
        from scipy.optimize import least_squares

        shooting = self.shooting(windows, hold, K, weight, x)
        if not len(theta):
            return theta, shooting
        low, high = (np.array([getattr(p, side) for p in self.model.parameters]) for side in ("low", "high"))
        inside = np.clip(theta, low, high)
        if not np.isfinite(shooting.residual(inside)).all():
            at = ", ".join(f"{p.name} = {v:g}" for p, v in zip(self.model.parameters, inside, strict=True))
            raise ModelError(f"{self.model.path}: the model diverges from the data at {at}; give other 'start' values")
        fit = least_squares(
            shooting.residual,
            inside,
            shooting.jacobian,
            bounds=(low, high),
            x_scale=np.array([parameter.size for parameter in self.model.parameters]),
            max_nfev=evaluations,
            xtol=1e-7,
            ftol=1e-7,
        )
        return np.asarray(fit.x), shooting

    def delay_and_hold(self) -> tuple[int, Hold, FloatArray, FloatArray]:
        """Return delay and hold, their parameters, and the size of the remaining errors.

        A grid over the delays is refined around its best; ramp and no delay are kept unless another choice fits better.
        """
        first = self.windows(0, _COARSE_WINDOWS)
        size = np.maximum(first.y.std(axis=(0, 1)), 1e-9)
        n, p = len(self.model.example.states), len(self.model.example.outputs)
        tried: dict[tuple[int, Hold], tuple[float, FloatArray, FloatArray]] = {}

        def cost(delay: int, hold: Hold, start: FloatArray) -> float:
            if (delay, hold) not in tried:
                windows = self.windows(delay, _COARSE_WINDOWS)
                weight = np.diag(1.0 / size)
                theta, shooting = self.fit(
                    start, windows, hold, np.zeros((n, p)), weight, evaluations=_COARSE_EVALUATIONS
                )
                left = _rms(shooting.errors(theta))
                tried[delay, hold] = (float(np.log(left).sum()), theta, left)
            return tried[delay, hold][0]

        cost(0, "first", self.model.start)
        size = np.maximum(tried.pop((0, "first"))[2], 1e-9)
        step = max(1, self.longest_delay // 5)
        for delay in range(0, self.longest_delay + 1, step):
            cost(delay, "first", self.model.start)
        while step > 1:
            step = (step + 1) // 2
            centre = min(tried, key=lambda key: tried[key][0])
            for delay in (centre[0] - step, centre[0] + step):
                if 0 <= delay <= self.longest_delay:
                    cost(delay, "first", tried[centre][1])
        best = min(tried, key=lambda key: tried[key][0])
        if self.model.example.domain == "continuous" and self.model.example.inputs:
            for delay in {best[0], max(best[0] - 1, 0)}:
                cost(delay, "zero", tried[best][1])
        best = min(tried, key=lambda key: tried[key][0])
        if tried[best][0] > tried[0, "first"][0] - p * _DELAY_GAIN:
            best = (0, "first")
        return best[0], best[1], tried[best][1], np.maximum(tried[best][2], 1e-9)

    def refined(
        self, delay: int, hold: Hold, theta: FloatArray, K: FloatArray, weight: FloatArray
    ) -> tuple[int, Hold, FloatArray, Shooting]:
        """Return delay, hold and parameters with the least prediction errors among the neighbours of those given.

        Half a sample of delay and a lag look alike in a simulation that disturbances move.
        """
        held = self.model.example.domain == "continuous" and bool(self.model.example.inputs)
        near: list[tuple[int, Hold]] = [(delay, hold), (delay - 1, "first"), (delay, "first"), (delay + 1, "first")]
        near += [(delay - 1, "zero"), (delay, "zero")] if held else []
        candidates: list[tuple[float, int, Hold, FloatArray, Shooting]] = []
        for d, h in dict.fromkeys(near):
            if 0 <= d <= self.longest_delay:
                estimate, shooting = self.fit(theta, self.windows(d, _MOST_WINDOWS), h, K, weight)
                cost = float(np.sum(shooting.residual(estimate) ** 2)) - (_SWITCH if (d, h) == (delay, hold) else 0.0)
                candidates.append((cost, d, h, estimate, shooting))
        return min(candidates, key=lambda candidate: candidate[0])[1:]

    def fitted(self, theta: FloatArray, hold: Hold, windows: Windows, noise: NoiseScales) -> FittedData:
        """Return the model's predictions of windows."""
        weight = np.linalg.cholesky(np.linalg.inv(noise.S))
        simulation = self.shooting(windows, hold, np.zeros_like(noise.K), np.diag(1.0 / np.sqrt(np.diag(noise.S))))
        errors = simulation.errors(theta)
        prediction = self.shooting(windows, hold, noise.K, weight, simulation.x)
        innovations = prediction.errors(theta)
        change = np.diff(windows.y, axis=1)
        return FittedData(
            measured=windows.y,
            simulated=windows.y - errors,
            innovations=innovations,
            states=prediction.states(theta),
            u=windows.u,
            simulated_share=1.0 - (errors**2).mean(axis=(0, 1)) / np.maximum(windows.y.var(axis=(0, 1)), 1e-300),
            predicted_share=1.0
            - (innovations[:, 1:] ** 2).mean(axis=(0, 1)) / np.maximum((change**2).mean(axis=(0, 1)), 1e-300),
        )


def _noise(signals: Plant, states: FloatArray, errors: FloatArray, rate_hz: float) -> NoiseScales:
    """Return the most likely scales of a plant's disturbances and noises."""
    sampled = discretise(linearised(signals, states.reshape(-1, states.shape[-1])), rate_hz)
    return fit_noise_scales(sampled.A, sampled.C, sampled.E_1, sampled.D_1, errors)


def _with_signals(plant: Plant) -> Plant:
    """Return the plant with a noise on every output, and with disturbances: on every state if it declares none."""
    outputs = np.eye(len(plant.outputs))
    own = tuple(int(np.flatnonzero(w.column)[0]) for w in plant.noises if np.count_nonzero(w.column) == 1)
    return replace(
        plant,
        disturbances=plant.disturbances or on_each(Disturbance, plant.states, np.ones(len(plant.states))),
        noises=plant.noises
        + tuple(Noise(f"noise_{name}", outputs[j]) for j, name in enumerate(plant.outputs) if j not in own),
    )


def _check_longest(model: FreeModel, segments: Sequence[Segment], rate_hz: float, needed: int) -> None:
    """Refuse segments if none is long enough for a window and the delays before it."""
    longest = max((len(segment.u) for segment in segments), default=0)
    if longest < needed:
        raise ModelError(
            f"{model.path}: the longest stretch of healthy samples lasts {longest / rate_hz:.1f} s; to fit and "
            f"to judge the fit takes {needed / rate_hz:.1f} s: record longer, or see [phase]"
        )


def _with_scales(plant: Plant, noise: NoiseScales) -> Plant:
    """Return the plant with its disturbances and noises at their most likely scales."""
    return replace(
        plant,
        disturbances=tuple(
            replace(w, scale=float(q)) for w, q in zip(plant.disturbances, noise.disturbances, strict=True)
        ),
        noises=tuple(replace(w, scale=float(r)) for w, r in zip(plant.noises, noise.noises, strict=True)),
    )


def _covariance(shooting: Shooting, theta: FloatArray, windows: int) -> FloatArray:
    """Return the covariance of the estimates: standard errors are the larger of classical and clustered ones."""
    k = len(theta)
    e, J = shooting.residual(theta), shooting.jacobian(theta)
    sizes = np.linalg.norm(J, axis=0)
    seen = sizes > 1e-12 * max(float(sizes.max(initial=0.0)), 1e-300)
    covariance = np.diag(np.where(seen, 0.0, np.inf))
    if not seen.any():
        return np.asarray(covariance)
    unit = J[:, seen] / sizes[seen]
    information, directions = np.linalg.eigh(unit.T @ unit)
    inverse = (directions / np.maximum(information, _UNSEEN)) @ directions.T
    freedom = max(1, len(e) - k - windows * len(shooting.x[0] if shooting.x is not None else ()))
    classical = inverse * float(e @ e) / freedom
    scores = np.einsum("wik,wi->wk", unit.reshape(windows, -1, int(seen.sum())), e.reshape(windows, -1))
    clustered = inverse @ (scores.T @ scores) @ inverse * windows / max(1, windows - 1)
    wider = np.sqrt(np.maximum(np.diag(clustered) / np.maximum(np.diag(classical), 1e-300), 1.0)) / sizes[seen]
    covariance[np.ix_(seen, seen)] = classical * np.outer(wider, wider)
    return covariance + np.diag((_LEAST_ERROR * theta) ** 2)


def _rms(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((np.nan_to_num(errors, nan=1e6, posinf=1e6, neginf=-1e6) ** 2).mean(axis=(0, 1))))
