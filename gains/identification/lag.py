"""What a sampled input does on average until the next sample, after transport delay, lag of an actuator and filter.

The input is taken as linear between samples. With the step response of the delay, the first-order lag and the low-pass
filter of the sensor in a row, each sample's share is the response to a triangle two samples wide, averaged over a step
of the grid. Filters are Butterworth's of second order, as ArduPilot and PX4 have for gyros; ``filter_s`` is their delay
at low frequencies, sqrt(2) over the angular cutoff.
"""

from math import ceil, floor

import numpy as np
from scipy.linalg.blas import dtbsv

from gains.plants.plant import FloatArray

_FINE = 8
"""Steps of the response's grid per sample. Measured on a lag of a fifth of a sample: 64 move no tap by 2e-3."""
_LAGS, _FILTERS = 9.0, 6.0
"""Lags and filter delays after which the response is complete: exp(-9) is .01 %, and exp(-6) .25 % of the filter."""
_HELD = 0.995
"""Share of the response that the taps of a running model hold: the rest is a tail that no observer sees."""
_NOTHING = 1e-9
"""Seconds below which a lag counts as none."""


def lag_taps(times_s: FloatArray, rate_hz: float, length: int | None = None) -> FloatArray:
    """Return the taps h, of sum 1: the response over the step after sample k is sum_d h_d u(k-d).

    What the next samples would add, where all is quicker than the grid or the input's stamps are late, is put onto the
    newest.

    ``times_s`` are transport delay, time constant of the lag, and delay of the filter (3,). The delay may be down to
    minus a sample: stamps of the input that are late against those of the output. ``length`` None takes as many taps as
    the whole response has.
    """
    delay_s, lag_s, filter_s = (float(time) for time in times_s)
    taps = length or ceil((delay_s + _LAGS * lag_s + _FILTERS * filter_s) * rate_hz) + 3
    step = 1.0 / (rate_hz * _FINE)
    count = (taps + 4) * _FINE
    pulse = np.zeros(count)
    centre = _FINE + delay_s / step + 0.5
    whole = floor(centre)
    pulse[whole : whole + 2] = 1.0 - (centre - whole), centre - whole
    t = step * np.arange(-1, count)
    t[0] = 0.0
    # responses to a ramp, whose second differences are the response to a pulse of one step, averaged over a step
    if lag_s > _NOTHING:
        pulse = _convolved(pulse, t - lag_s * (1.0 - np.exp(-t / lag_s)))
    if filter_s > _NOTHING:
        pulse = _convolved(pulse, t - filter_s * (1.0 - np.exp(-t / filter_s) * np.cos(t / filter_s)))
    for _ in range(3):  # the step it is averaged over, and the two that make a triangle
        total = np.cumsum(np.append(np.zeros(_FINE), pulse))
        pulse = (total[_FINE:] - total[:-_FINE]) / _FINE
    response = pulse[_FINE - 1 :: _FINE] * _FINE
    shares = response[2 : taps + 2].copy()
    shares[0] += response[:2].sum()
    return np.asarray(shares / shares.sum())


def shortened(taps: FloatArray) -> FloatArray:
    """Return the fewest first taps that hold 99.5 % of the response, of sum 1."""
    held = taps[: int(np.searchsorted(np.cumsum(taps), _HELD)) + 1]
    return np.asarray(held / held.sum())


def followed(drive: FloatArray, keep: float, start: float = 0.0) -> FloatArray:
    """Return x(0) = start and x(k+1) = keep x(k) + drive(k) along the last axis, (..., N + 1) for drives (..., N).

    The recursion is a triangular system with one diagonal below its main one. :func:`scipy.signal.lfilter` takes two
    thirds of the time, and its import half a second.
    """
    x = np.concatenate([np.full((*drive.shape[:-1], 1), start), drive], axis=-1)
    band = np.repeat(np.array([[1.0], [-keep]]), x.shape[-1], axis=1)
    for row in x.reshape(-1, x.shape[-1]):
        row[:] = dtbsv(1, band, row, lower=1, diag=1)
    return x


def _convolved(pulse: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return a signal after a system with this response to a ramp, given from one step before 0 on."""
    kernel = np.diff(ramp, 2) / (ramp[-1] - ramp[-2])
    return np.asarray(np.convolve(pulse, kernel)[: len(pulse)])
