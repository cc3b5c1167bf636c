"""Give back what washing out takes from a fault that lasts.

An observer of washed-out positions and angles sees a fault f through the same washout,

    f_w' = f' - f_w / tau,     whose exact inverse is     f = f_w + (1/tau) * integral of f_w dt,

so a step fades and, when the fault ends, swings to the other side. Integrated for ever the inverse would grow with
every error of healthy operation; it is integrated only while |f_w| is large:

- no fault (integral zero) and |f_w| <= threshold / 2: f = f_w;
- |f_w| > threshold / 2: the integral runs (by the trapezoidal rule), and f = f_w + integral / tau;
- |f_w| <= threshold / 2 again while f is still large: the fault lasts, fully washed out; the integral is held;
- |f| back within the threshold, or within a tenth of its peak (errors of a tenth leave as much): the fault is over, and
  zero is given until |f_w| has settled too, when everything is forgotten.

The rule itself is :class:`monitor.core.bank.Washout`.
"""

from __future__ import annotations

from monitor.core.bank import Washout


def washout_inverse(tau: float, rate_hz: float, threshold: float) -> Washout:
    """Return the inverse of the washout of one fault channel; :meth:`Washout.run` takes n rows.

    It is given the smoothed estimate of the channel under its own hypothesis, every sample, whichever hypothesis is
    believed: switching it off and on would cut pieces out of the integral.

    Parameters
    ----------
    tau : float
        Time constant of the washout, seconds.
    rate_hz : float
        Samples per second.
    threshold : float
        Alarm threshold of the channel, in its unit.
    """
    return Washout(share=0.5 / (tau * rate_hz), threshold=threshold)
