# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Least squares of an actuator's loss and offset under several memories, row after row.

:mod:`monitor.estimation.effectiveness` explains the rules, in the same symbols.
"""

from libc.math cimport INFINITY, NAN, exp, fabs, isnan, sqrt

import numpy as np

# Range of a loss: none is more than everything, and an actuator that seems to deliver much more than commanded is out
# of trim. Chosen: a quarter more.
cdef double LEAST_LOSS = -0.25
cdef double LARGEST_LOSS = 1.0
# Standard errors within which a size counts as healthy: 95 of 100 times.
cdef double ACQUITTAL = 2.0
# Health contradicts an accusation if it explains the data better by this much, in squared standard errors: three
# standard errors.
cdef double CONTRADICTION = 9.0
# Information is 1 / variance of sizes near 1: below this there is none; it avoids a division by zero.
cdef double SMALLEST_INFORMATION = 1e-30
# Time constant of the run's own misfit, seconds: weather lasts for minutes, and half a second of a fault that the
# fitted sizes do not explain yet adds a fortieth of it.
cdef double MISFIT_S = 20.0
# Largest square with which a row counts in the misfit, as a multiple of the misfit: otherwise one absurd value would
# hide a fault for minutes; so it makes the misfit 1.4 times as large. Chosen: twenty deviations; a storm of five is
# followed within a second.
cdef double MISFIT_CLIP = 400.0
# Largest factor by which errors of the model may exceed those of the fitted flights; after one absurd value it fades
# within 2 s. Chosen: that of a tumble at thirty times the fitted rates; ten times was seen.
cdef double MOST_BEYOND = 1000.0
# Time constant with which model errors outlast the motion that causes them, seconds: rates decay in about that time.
cdef double BEYOND_S = 0.3
# Effects are near 1. Values a million times larger come from a broken sender, and their squares would exceed all
# others.
cdef double LARGEST_EFFECT = 1e6

cdef struct Doubt:
    # Factor by which errors of the model exceed those of the fitted flights, and that of the variance of the noise.
    double beyond, noise

cdef struct Verdict:
    # Evidence and relative are NaN where they are not known.
    double loss, loss_error, offset, offset_error, score, evidence, relative
    bint is_loss


cdef class EffectivenessEstimator:
    """State of one actuator's recursive least squares.

    Parameters
    ----------
    rule : EffectivenessRule
        How its estimate is read.
    rate_hz : float
        Rows per second.

    Attributes
    ----------
    misfit : float
        Mean square, over the last 20 s, of the part of f^ that loss and offset leave, over noise^2.
    """

    cdef list memories
    cdef double lag_keep, rate_hz, certainty, u, m, size
    cdef double noise, usual_misfit, misfit_keep, beyond, beyond_keep, larger
    cdef readonly double misfit
    cdef long long longest_ns, used_ns
    cdef Py_ssize_t hold, unconfirmed
    cdef bint used, lagged

    def __init__(self, rule, rate_hz):
        self.memories = [Memory(rule, memory_s, rate_hz) for memory_s in rule.memories_s]
        self.lag_keep = exp(-1.0 / (rule.lag_s * rate_hz)) if rule.lag_s > 0.0 else 0.0
        self.rate_hz, self.certainty = rate_hz, rule.certainty
        self.longest_ns = round(max(rule.memories_s) * 1e9)
        self.hold = self.unconfirmed = round(rule.hold_s * rate_hz)
        self.used, self.used_ns, self.size = False, 0, 0.0
        self.noise, self.usual_misfit, self.misfit = rule.noise, rule.misfit, rule.misfit
        self.misfit_keep, self.beyond_keep = exp(-1.0 / (MISFIT_S * rate_hz)), exp(-1.0 / (BEYOND_S * rate_hz))
        self.restart()

    def run(self, const long long[:] times_ns, const unsigned char[:] restart, const unsigned char[:] armed,
            const double[:] fault, const double[:] command, const double[:] full, const double[:] beyond):
        """Process n rows; return the 9 columns of an ``EffectivenessRun`` (9, n).

        All is forgotten at a restart, and where evidence (``armed``) was missing for longer than the longest memory.
        ``fault``, ``command`` and ``full`` (n,) are the observer's f^, not smoothed further, u in the same units, and
        m, the effect of a constant full deflection; ``beyond`` is the factor by which the model's errors may exceed
        those of the fitted flights, 1 inside of them.
        """
        cdef Py_ssize_t k, count = times_ns.shape[0]
        cdef bint afresh
        cdef Verdict verdict
        if not (count == restart.shape[0] == armed.shape[0] == fault.shape[0] == command.shape[0] == full.shape[0]
                == beyond.shape[0]):
            raise ValueError("the columns differ in length")
        result = np.full((9, count), NAN)
        cdef double[:, ::1] columns = result
        for k in range(count):
            # Begin anew with the observer, and where evidence was missing for longer than the longest memory.
            afresh = restart[k] or not self.used or times_ns[k] - self.used_ns > self.longest_ns
            if armed[k] and is_effect(fault[k]) and is_effect(command[k]) and is_effect(full[k]):
                if afresh:
                    self.restart()
                self.used, self.used_ns = True, times_ns[k]
                verdict = self.update(fault[k], command[k], full[k], beyond[k])
                if not isnan(verdict.evidence):
                    self.size = verdict.evidence
                columns[0, k], columns[1, k] = verdict.loss, verdict.loss_error
                columns[2, k], columns[3, k] = verdict.offset, verdict.offset_error
                columns[4, k], columns[5, k], columns[6, k] = verdict.score, verdict.evidence, share_of(&verdict)
            elif afresh:
                self.used, self.size = False, 0.0
            else:
                self.skip()
            columns[7, k], columns[8, k] = self.size, self.larger
        return result

    cdef void restart(self) noexcept:
        self.lagged, self.beyond, self.larger = False, 1.0, 1.0
        self.forget()

    cdef void forget(self) noexcept:
        cdef Py_ssize_t i
        for i in range(len(self.memories)):
            (<Memory> self.memories[i]).clear()
        self.unconfirmed = self.hold

    cdef void skip(self) noexcept:
        """Let a row pass that is no evidence."""
        cdef Py_ssize_t i
        self.unconfirmed = min(self.unconfirmed + 1, self.hold)
        for i in range(len(self.memories)):
            (<Memory> self.memories[i]).add(0.0, 0.0, 0.0, 0.0, 1.0)

    cdef Doubt doubt(self, double fault, double beyond) noexcept:
        """Return the factors by which errors of the model and the variance of the noise exceed those of the fitted
        flights.

        Errors of the model grow with how far the motion is beyond that of the fitted flights, and last a while. Further
        errors, gusts for instance, show in what the sizes of the longest memory leave of f^.
        """
        cdef Memory longest = <Memory> self.memories[len(self.memories) - 1]
        cdef double rest
        self.beyond = max(min(beyond, MOST_BEYOND), 1.0 + self.beyond_keep * (self.beyond - 1.0))
        if self.usual_misfit > 0.0:
            rest = longest.rest(fault, self.u, self.m) / (self.noise * self.beyond)
            rest = min(rest * rest, MISFIT_CLIP * max(self.misfit, self.usual_misfit))
            self.misfit = self.misfit_keep * self.misfit + (1.0 - self.misfit_keep) * rest
            return Doubt(self.beyond, max(1.0, self.misfit / self.usual_misfit))
        return Doubt(self.beyond, 1.0)

    cdef Verdict update(self, double fault, double command, double full, double beyond) noexcept:
        cdef Py_ssize_t i, count = len(self.memories)
        cdef double gain = 1.0 - self.lag_keep, step
        cdef Doubt doubt
        cdef Memory shortest = <Memory> self.memories[0]
        cdef Verdict verdict
        # u and m with the same lag as f^ has behind the fault, and the rate of change of u.
        if not self.lagged:
            self.u, self.m, self.lagged = command, full, True
        step = gain * (command - self.u)
        self.u += step
        self.m += gain * (full - self.m)
        doubt = self.doubt(fault, beyond)
        self.larger = doubt.beyond * sqrt(doubt.noise)
        for i in range(count):
            (<Memory> self.memories[i]).add(fault, self.u, self.m, step * self.rate_hz, doubt.beyond)
        # The shortest memory that has a verdict decides; where none has, the sizes of the longest one are returned.
        for i in range(count):
            verdict = (<Memory> self.memories[i]).judge(doubt)
            if not isnan(verdict.evidence):
                break
        verdict.relative = NAN
        if is_accusation(&verdict):
            if shortest.contradicts(&verdict, doubt):
                self.forget()
                verdict.evidence = 0.0
                return verdict
            for i in range(count):
                verdict.relative = (<Memory> self.memories[i]).loss_beside_offset(doubt)
                if not isnan(verdict.relative):
                    break
        verdict.evidence = self.confirmed(&verdict, doubt)
        return verdict

    cdef double confirmed(self, Verdict* verdict, Doubt doubt) noexcept:
        """Return the evidence; zero after ``hold`` rows in which no memory could have confirmed the accusation."""
        cdef Py_ssize_t i
        cdef Memory shortest = <Memory> self.memories[0]
        if is_accusation(verdict):
            for i in range(len(self.memories)):
                if (<Memory> self.memories[i]).reach(shortest, verdict) >= self.certainty * sqrt(doubt.noise):
                    self.unconfirmed = 0
                    return verdict.evidence
        self.unconfirmed = min(self.unconfirmed + 1, self.hold)
        return verdict.evidence if self.unconfirmed < self.hold else 0.0


cdef class Memory:
    """Information Lambda = [uu um; um mm] and moments b = [bu bm] under one time constant of forgetting."""

    cdef double uu, um, mm, bu, bm, su, sm
    cdef double forget, weight, length, inflation
    cdef double loss_doubt, offset_doubt, timing_s, certainty, least_loss, least_offset

    def __init__(self, rule, memory_s, rate_hz):
        self.length = memory_s * rate_hz
        self.forget = exp(-1.0 / self.length)
        # Noise slower than the memory does not average out in it, but does not grow either.
        self.inflation = min(rule.inflation, self.length)
        self.weight = 1.0 / (rule.noise * rule.noise * self.inflation)
        self.loss_doubt, self.offset_doubt, self.timing_s = rule.loss_doubt, rule.offset_doubt, rule.timing_s
        self.certainty, self.least_loss, self.least_offset = rule.certainty, rule.least_loss, rule.least_offset
        self.clear()

    cdef void clear(self) noexcept:
        self.uu = self.um = self.mm = self.bu = self.bm = 0.0
        # Moments of u', the rate of change of u, with the regressors.
        self.su = self.sm = 0.0

    cdef void add(self, double fault, double u, double m, double speed, double beyond) noexcept:
        """Lambda <- forget Lambda + w phi phi', b <- forget b + w phi f^ with phi = [-u, m]."""
        cdef double forget = self.forget, weight = self.weight / (beyond * beyond)
        self.uu = forget * self.uu + weight * u * u
        self.um = forget * self.um - weight * u * m
        self.mm = forget * self.mm + weight * m * m
        self.bu = forget * self.bu - weight * u * fault
        self.bm = forget * self.bm + weight * m * fault
        self.su = forget * self.su + weight * u * speed
        self.sm = forget * self.sm + weight * m * speed

    cdef Verdict judge(self, Doubt doubt) noexcept:
        """Return loss alone and offset alone, each tested against its own standard error, and the evidence of the
        better one."""
        cdef Verdict v
        cdef bint matters
        cdef double loss_doubt = doubt.beyond * self.loss_doubt, offset_doubt = doubt.beyond * self.offset_doubt
        v.loss, v.loss_error = 0.0, INFINITY
        v.offset, v.offset_error = 0.0, INFINITY
        if self.uu > SMALLEST_INFORMATION:
            v.loss = self.bu / self.uu
            v.loss_error = self.error(self.uu, self.um * offset_doubt, self.su, loss_doubt, doubt.noise)
        if self.mm > SMALLEST_INFORMATION:
            v.offset = self.bm / self.mm
            v.offset_error = self.error(self.mm, self.um * loss_doubt, self.sm, offset_doubt, doubt.noise)
        v.is_loss = plausible(v.loss, v.loss_error) and v.loss * self.bu >= v.offset * self.bm
        v.score = fabs(v.loss) / v.loss_error if v.is_loss else fabs(v.offset) / v.offset_error
        matters = fabs(v.loss) >= self.least_loss if v.is_loss else fabs(v.offset) >= self.least_offset
        v.evidence = v.relative = NAN
        if v.score >= self.certainty and matters:
            v.evidence = -v.loss * sqrt(self.uu / max(self.mm, SMALLEST_INFORMATION)) if v.is_loss else v.offset
        elif (fabs(v.loss) + ACQUITTAL * v.loss_error < self.least_loss
                and fabs(v.offset) + ACQUITTAL * v.offset_error < self.least_offset):
            v.evidence = 0.0
        return v

    cdef double rest(self, double fault, double u, double m) noexcept:
        """Return the part of f^ that loss and offset together leave, or f^ itself where that is smaller."""
        cdef double determinant = self.uu * self.mm - self.um * self.um, loss, offset, rest
        if not determinant > SMALLEST_INFORMATION:
            return fault
        loss = (self.mm * self.bu - self.um * self.bm) / determinant
        offset = (self.uu * self.bm - self.um * self.bu) / determinant
        rest = fault + loss * u - offset * m
        return rest if fabs(rest) < fabs(fault) else fault

    cdef double error(self, double own, double other, double speed, double doubt, double noise) noexcept:
        """Return the standard error of one size fitted alone: noise, its model error, that of the other size, and
        timing."""
        cdef double of_other = other / own, of_timing = speed * self.timing_s / own
        return sqrt(noise / own + doubt * doubt + of_other * of_other + of_timing * of_timing)

    cdef double loss_beside_offset(self, Doubt doubt) noexcept:
        """Return -loss of the joint fit where it is certain and plausible, else NaN."""
        cdef double determinant = self.uu * self.mm - self.um * self.um, beside, slip, error
        if not determinant > SMALLEST_INFORMATION:
            return NAN
        beside = (self.mm * self.bu - self.um * self.bm) / determinant
        slip = self.timing_s * (self.mm * self.su + self.um * self.sm) / determinant
        error = sqrt(doubt.noise * self.mm / determinant + slip * slip + self.loss_doubt * self.loss_doubt)
        return -beside if self.certainty * error <= fabs(beside) and plausible(beside, error) else NAN

    cdef bint contradicts(self, Verdict* verdict, Doubt doubt) noexcept:
        """Return whether health explains the data of this memory better than the accusation does."""
        if verdict.is_loss:
            return verdict.loss * (verdict.loss * self.uu - 2.0 * self.bu) > CONTRADICTION * doubt.noise
        return verdict.offset * (verdict.offset * self.mm - 2.0 * self.bm) > CONTRADICTION * doubt.noise

    cdef double reach(self, Memory shortest, Verdict* verdict) noexcept:
        """Return how many standard errors the accusation would be in this memory if the excitation of late went on."""
        cdef double size = verdict.loss if verdict.is_loss else verdict.offset
        cdef double lately = shortest.uu if verdict.is_loss else shortest.mm
        return fabs(size) * sqrt(lately * shortest.inflation / shortest.length * self.length / self.inflation)


cdef bint is_effect(double value) noexcept:
    """Return whether a value can be an effect, which is near 1: a network may send anything."""
    return fabs(value) < LARGEST_EFFECT


cdef bint is_accusation(Verdict* verdict) noexcept:
    return verdict.evidence != 0.0 and not isnan(verdict.evidence)


cdef double share_of(Verdict* verdict) noexcept:
    """Return the share of the command that is missing, as a negative number, where it is known."""
    if isnan(verdict.relative) and verdict.is_loss and is_accusation(verdict):
        return -verdict.loss
    return verdict.relative


cdef bint plausible(double loss, double error) noexcept:
    """Return whether a loss can be real: at most everything, and not far more than commanded, within its error."""
    return error < INFINITY and LEAST_LOSS <= loss <= LARGEST_LOSS + ACQUITTAL * error
