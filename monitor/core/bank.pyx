# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Turns estimates and residuals into evidence, row after row: choice of a hypothesis, edges, washouts, joint isolation.

:mod:`monitor.estimation` tells what these rules are for. Sums are taken in one fixed order, so that results do not
depend on how a stream is cut.
"""

from libc.math cimport INFINITY, fabs, isnan, sqrt

import numpy as np

# Another hypothesis replaces the believed one if its J is smaller by this factor. Measured on five recorded quadrotor
# flights: 1, 1.5, 2 and 4 change the hypothesis in 28, 16, 13 and 8 % of the rows; the alarms are the same, and from 2
# on the sizes in their events too.
cdef double LOYALTY = 2.0
# Between an actuator that delivers less and one that delivers more, a mean of J decides, whose time constant is this
# multiple of the smoothing's. Such two hypotheses explain the data equally well but for one weak axis (yaw of a
# multirotor), where they differ by (2 y)^2, y being the effect there. Disturbances of that axis average out, the effect
# does not. Chosen: 0.3 s at 100 Hz, as long as a gust in the body rates.
cdef double RIVALS_MEAN = 6.0
# An actuator that delivers more is in question once its mean J is better by this share of gain_penalty; until the
# decision none of the two is held responsible. Chosen: a difference of 5 in J is 2.5 nats, odds of 12; noise does not
# delay a loss.
cdef double RIVALS_OPEN = 0.2
# Share of the J of one hypothesis below which another one is clearly nearer: half of its residual. Chosen: errors of
# the model leave a fifth of a fault (tolerance) on the right hypothesis, two of them less than a half.
cdef double CLEAR = 0.25
# Share of the mean of a fault over level_s below which what lasted has ended: halfway.
cdef double GONE = 0.5
# Largest mean J of an actuator that delivers more, as a multiple of the limit below which a J explains the data.
# Measured on losses put into a flight at 100 Hz: without this limit a third motor was named at the end of one of two
# losses in 4 of 36 runs; with a factor of 1 a motor that delivers 10 % more is named 0.07 s later; with 4 neither
# happens.
cdef double AFTER_SEVERAL = 4.0
# J by which a hypothesis has to be ahead of another one that explains the data, in its mean over a moment or in what
# lasts, for the two to be told apart: 7 nats, odds of a thousand, as of sudden changes. Two that were told apart stay
# so down to half of it, so noise does not make that flicker.
cdef double TOLD = 14.0
# Where one actuator alone explains the data too, the smaller of two losses has to be this share of the larger one: a
# smaller one may be an error of the model. Chosen: above the tolerance for such errors, a fifth.
cdef double SECOND_SHARE = 0.25
# Share of score_floor^2 by which the mean J of two losses has to be below that of one, unless the lasting J decides: at
# most what healthy flight leaves unexplained, as the floor is twice the score of health (MARGIN of
# monitor.fitting.calibrate).
cdef double SECOND_APART = 0.25
# J by which what lasts has to be smaller under a hypothesis that is believed in calm alone, in gain_penalty: twice what
# turns left of it after a time without any (CALM_LEVELS of monitor.estimation.bank).
cdef double CALM_APART = 2.0
# A level is flat if it changes by less than this share of the step. A ramp through the window changes a level by flat /
# (gap + mean), 1.7 steps. Chosen: far below that, with room for noise of an eighth of the step.
cdef double EDGE_SHARE = 0.25
# Share of the step that may fade within the second level: an attitude that follows a sensor's jump takes it back, while
# a ramp goes on. Chosen: half, as for the end of an edge.
cdef double EDGE_FADED = 0.5
# An edge after which less than this share of it, and of the level before it, is left ends the fault. Chosen: halfway
# between a sensor that is right again and one that jumped once more.
cdef double EDGE_CANCELLED = 0.5
# Largest share of bridged rows in the window of an edge: lines over lost measurements are flat and have corners.
# Without this limit two of twelve healthy runs with 30 % of the messages lost raised a gyro alarm.
cdef double EDGE_BRIDGED = 0.6
# Shares of the threshold and of the peak, explained at Washout. Chosen: a smaller share of the threshold would
# integrate errors of healthy operation, a larger one would lose more of a slow fault; an error of a tenth in scale or
# time constant leaves a tenth of the peak after the fault has ended.
cdef double WASHOUT_QUIET = 0.5
cdef double WASHOUT_OVER = 0.1
# The end of a fault that was let go may differ from it by this share. Chosen: halfway to another fault, as for edges; a
# fault that creeps while its size is held changes by as much.
cdef double WASHOUT_RETURNED = 0.5
# A row counts in the level with a J of at most this multiple of that in healthy flight. Chosen: six deviations.
# Measured: a windy flight watched with the profile of a calm one has 11 on average and 36 over ten seconds.
cdef double LEVEL_CLIP = 36.0


cdef inline double squared(const double[:, :] W, const double[:] r) noexcept:
    """Return |W r|^2."""
    cdef Py_ssize_t i, j
    cdef double white, total = 0.0
    for i in range(W.shape[0]):
        white = 0.0
        for j in range(W.shape[1]):
            white += W[i, j] * r[j]
        total += white * white
    return total


cdef class Choice:
    """The hypothesis of a bank that is believed, and the evidence it gives; see :mod:`monitor.estimation.bank`.

    K hypotheses have F faults in total (columns), which belong to a channels.

    Parameters
    ----------
    whitening : ndarray
        W_k of each hypothesis' smoothed residual (K, p, p).
    lasting : ndarray
        The same of the mean of that residual over level_s (K, p, p).
    spans : ndarray
        Where the columns of each hypothesis begin (K + 1,).
    channel : ndarray
        The channel of each column (F,).
    shown : ndarray
        The column whose estimate is returned for each channel: that of its smallest hypothesis (a,).
    scaling : ndarray of bool
        Columns of faults that scale an input (F,).
    groups : list of ndarray
        The hypotheses that are compared, by their number of faults, the fewest first.
    own : ndarray of bool
        Channels that only some of the compared hypotheses have (K, a).
    edges : sequence of (hypothesis, column, EdgeDetector)
        The hypotheses that are not compared, with each fault that only they have.
    washouts : sequence of (channel, Washout)
        Channels whose washout is inverted.
    keep : float
        Weight of the smoothed values before a row.
    floor, share, penalty : float
        score_floor^2, tolerance^2 and gain_penalty of the rule.
    usual, follow : float
        Mean of the smallest J in healthy flight (0: its level is not followed), and the weight of a row in the level
        and in the mean residuals.
    calm : ndarray, optional
        Largest size of each output with which a hypothesis is believed, 0 for any (K, p).
    calm_rows : int
        For how many rows no output was larger.
    """

    cdef double[:, :, ::1] whitening, lasting
    cdef double[:, ::1] calm
    cdef unsigned char[::1] only_in_calm, barred
    cdef Py_ssize_t[::1] still
    cdef Py_ssize_t calm_rows
    cdef Py_ssize_t[::1] spans, channel, shown, compared, group, rival
    cdef Py_ssize_t[:, ::1] exchanged
    cdef unsigned char[::1] scaling, is_compared, remembered, counted
    cdef unsigned char[:, ::1] own
    cdef list detectors, washouts
    cdef Py_ssize_t[::1] watched, watched_column, washed
    cdef double keep, floor, share, penalty, limit, unexplained, usual, follow, level, keep_mean, least
    cdef double[:, ::1] residual, mean_residual
    cdef double[::1] fault, mean_fault, J, mean_J, lasting_J, evidence
    cdef Py_ssize_t believed
    cdef bint coasted, open

    def __init__(self, whitening, lasting, spans, channel, shown, scaling, groups, own, edges, washouts, keep, floor,
                 share, penalty, usual=0.0, follow=0.0, calm=None, calm_rows=0):
        K, p, a = len(whitening), whitening.shape[1], len(shown)
        self.calm = np.zeros((K, p)) if calm is None else np.ascontiguousarray(calm, float)
        self.only_in_calm, self.barred = np.any(self.calm, axis=1).astype(np.uint8), np.zeros(K, np.uint8)
        self.still, self.calm_rows = np.zeros(K, np.intp), calm_rows
        self.whitening, self.lasting = np.ascontiguousarray(whitening), np.ascontiguousarray(lasting)
        self.spans, self.channel, self.shown = (np.asarray(indices, np.intp) for indices in (spans, channel, shown))
        self.scaling, self.own = np.asarray(scaling, np.uint8), np.ascontiguousarray(own, np.uint8)
        # Hypotheses in the order of preference, and the rank of the group of each.
        self.compared = np.concatenate(groups).astype(np.intp)
        self.group = np.repeat(np.arange(len(groups)), [len(members) for members in groups]).astype(np.intp)
        self.watched = np.array([k for k, _, _ in edges], np.intp)
        self.watched_column = np.array([column for _, column, _ in edges], np.intp)
        self.detectors = [detector for _, _, detector in edges]
        self.washed = np.array([channel for channel, _ in washouts], np.intp)
        self.washouts = [washout for _, washout in washouts]
        self.keep, self.floor, self.share, self.penalty = keep, floor, share, penalty
        self.usual, self.follow, self.level = usual, follow, 1.0
        self.residual, self.mean_residual, self.fault = np.zeros((K, p)), np.zeros((K, p)), np.zeros(len(channel))
        self.mean_fault = np.zeros(len(channel))
        self.J, self.mean_J, self.lasting_J, self.evidence = np.zeros(K), np.zeros(K), np.zeros(K), np.zeros(a)
        self.keep_mean, self.least, self.open = keep ** (1.0 / RIVALS_MEAN), 0.0, False
        self.is_compared, self.counted = np.ones(a, np.uint8), np.ones(a, np.uint8)
        for column in self.watched_column:
            self.is_compared[self.channel[column]] = False
        self.remembered = np.zeros(len(self.washouts), np.uint8)
        self.rival, self.limit = np.full(a, -1, np.intp), floor
        # The channel that one hypothesis has and another does not, where they differ in one each.
        members = [{self.channel[i] for i in range(self.spans[k], self.spans[k + 1])} for k in range(K)]
        apart = [[list(one - other) if len(one - other) == len(other - one) == 1 else [-1] for other in members]
                 for one in members]
        self.exchanged = np.array(apart, np.intp)[:, :, 0]
        self.believed, self.unexplained, self.coasted = self.compared[0], 0.0, False

    def run(self, const double[:, :, :] x, const double[:, :] fault, const double[:, :, :] residual,
            const double[:, :] y, const unsigned char[:] measured, const unsigned char[:] complete,
            const unsigned char[:] restart, const unsigned char[:] armed, const double[:] beyond,
            const unsigned char[:] corrected=None, const unsigned char[:] resumed=None):
        """Return x, fault, believed residual, evidence, counted, smoothed, unexplained, level, rival, let go of n rows.

        x (n, K, states), fault (n, F) and residual (n, K, p) are the estimates of the observers from y (n, p). A row
        that is neither measured nor a restart does not change the choice. The level is followed over rows that are
        evidence (``armed``). ``beyond`` is the factor by which all sizes are larger outside of the fitted flights;
        None: 1. Where y was ``corrected`` (None: nowhere), the residual is a jump of the data, not of a sensor, and is
        left out. A restart at which the same flight is ``resumed`` (None: none is) keeps the restored washed-out
        faults. Faults that were let go without having been seen to end are in the last result (:class:`Washout`).
        """
        cdef Py_ssize_t k, i, count = x.shape[0], states = x.shape[2], p = residual.shape[2], a = self.shown.shape[0]
        if not count == fault.shape[0] == residual.shape[0] == y.shape[0]:
            raise ValueError("x, fault, residual and y differ in length")
        if not count == measured.shape[0] == complete.shape[0] == restart.shape[0] == armed.shape[0] or (
            beyond is not None and beyond.shape[0] != count or corrected is not None and corrected.shape[0] != count
            or resumed is not None and resumed.shape[0] != count
        ):
            raise ValueError("x, measured, complete, restart, armed, beyond, corrected and resumed differ in length")
        if x.shape[1] != self.J.shape[0] or residual.shape[1] != self.J.shape[0] or (
            not p == self.residual.shape[1] == y.shape[1]
        ):
            raise ValueError("x, residual and y are not of the bank's hypotheses and outputs")
        if fault.shape[1] != self.fault.shape[0]:
            raise ValueError(f"{fault.shape[1]} faults, not {self.fault.shape[0]}")
        results = (
            np.empty((count, states)), np.empty((count, a)), np.empty((count, p)), np.empty((count, a)),
            np.empty((count, a), np.bool_), np.empty((count, a)), np.empty(count), np.empty(count),
            np.empty((count, a), np.intp), np.zeros((count, a), np.bool_),
        )
        cdef unsigned char[:, ::1] let_go = results[9]
        cdef Py_ssize_t[:, ::1] rival = results[8]
        cdef double[:, ::1] shown_x = results[0], shown_fault = results[1], shown_residual = results[2]
        cdef double[:, ::1] evidence = results[3], smoothed = results[5]
        cdef unsigned char[:, ::1] counted = results[4]
        cdef double[::1] unexplained = results[6], level = results[7]
        cdef double brought
        for k in range(count):
            if restart[k]:
                self.clear(resumed is not None and resumed[k])
            level[k] = self.level
            if measured[k] or restart[k]:
                self.follow_calm(y, k)
                self.update(fault, residual, k, complete[k] and not self.coasted,
                            1.0 if beyond is None else beyond[k], corrected is not None and corrected[k])
                # Data that no hypothesis explains are no weather: they must not raise the level and hide themselves.
                if armed[k] and self.usual > 0.0 and self.unexplained == 0.0:
                    brought = max(1.0, self.level) * self.least / self.usual
                    self.level += self.follow * (min(brought, LEVEL_CLIP) - self.level)
            self.coasted = not (measured[k] or restart[k])
            for i in range(states):
                shown_x[k, i] = x[k, self.believed, i]
            for i in range(p):
                shown_residual[k, i] = residual[k, self.believed, i]
            for i in range(a):
                shown_fault[k, i] = fault[k, self.shown[i]]
                smoothed[k, i] = self.fault[self.shown[i]]
                evidence[k, i] = self.evidence[i]
                counted[k, i] = self.counted[i]
                rival[k, i] = self.rival[i]
            for i in range(self.washed.shape[0]):
                let_go[k, self.washed[i]] = (<Washout> self.washouts[i]).gone != 0.0
            unexplained[k] = self.unexplained
        return results

    cdef void clear(self, bint resumed) noexcept:
        cdef Py_ssize_t i
        self.residual[:] = 0.0
        self.mean_residual[:] = 0.0
        self.fault[:] = 0.0
        self.mean_fault[:] = 0.0
        self.mean_J[:] = 0.0
        self.lasting_J[:] = 0.0
        self.remembered[:] = 0
        self.rival[:] = -1
        self.still[:] = 0
        self.open = False
        for i in range(self.watched.shape[0]):
            (<EdgeDetector> self.detectors[i]).clear()
        for i in range(self.washed.shape[0]):
            if resumed:
                self.remembered[i] = (<Washout> self.washouts[i]).resume()
            else:
                (<Washout> self.washouts[i]).clear()

    cdef void update(self, const double[:, :] fault, const double[:, :, :] residual, Py_ssize_t row,
                     bint complete, double beyond, bint corrected) noexcept:
        cdef Py_ssize_t k, i, K = self.J.shape[0], p = self.residual.shape[1]
        cdef double keep = self.keep, level = max(1.0, self.level)
        cdef bint explained
        # Smoothed residuals r_k, J_k = |W_k r_k|^2 / lambda, the same of their mean over level_s, and smoothed faults.
        for k in range(K):
            for i in range(0 if corrected else p):
                self.residual[k, i] = keep * self.residual[k, i] + (1.0 - keep) * residual[row, k, i]
                self.mean_residual[k, i] += self.follow * (self.residual[k, i] - self.mean_residual[k, i])
            self.J[k] = squared(self.whitening[k], self.residual[k]) / level
            self.mean_J[k] = self.keep_mean * self.mean_J[k] + (1.0 - self.keep_mean) * self.J[k]
            self.lasting_J[k] = squared(self.lasting[k], self.mean_residual[k]) / level
        for i in range(self.fault.shape[0]):
            self.fault[i] = keep * self.fault[i] + (1.0 - keep) * fault[row, i]
            self.mean_fault[i] += self.follow * (self.fault[i] - self.mean_fault[i])
        self.choose()
        explained = self.unexplained == 0.0
        for i in range(self.evidence.shape[0]):
            self.evidence[i] = 0.0
            self.counted[i] = (explained and not self.open) or not self.is_compared[i]
        if explained:
            for i in range(self.spans[self.believed], self.spans[self.believed + 1]):
                self.evidence[self.channel[i]] = self.fault[i]
        self.find_rivals(explained)
        self.give_back(explained, beyond)
        self.watch_edges(fault, row, complete)

    cdef void follow_calm(self, const double[:, :] y, Py_ssize_t row) noexcept:
        """Count for how many rows no output was too large for a hypothesis that is believed in calm alone."""
        cdef Py_ssize_t k, i
        for k in range(self.still.shape[0]):
            self.still[k] += 1
            for i in range(self.calm.shape[1] if self.only_in_calm[k] else 0):
                if fabs(y[row, i]) > self.calm[k, i] > 0.0:
                    self.still[k] = 0

    cdef bint is_barred(self, Py_ssize_t k) noexcept:
        """Return whether a hypothesis is left out, as it is believed in calm alone."""
        cdef Py_ssize_t i
        if not self.only_in_calm[k] or k == self.believed:
            return False
        if self.still[k] < self.calm_rows:
            return True
        for i in range(self.compared.shape[0]):
            if self.faults(self.compared[i]) == 1 and not self.lasts(k, self.compared[i], CALM_APART * self.penalty):
                return True
        return False

    cdef void choose(self) noexcept:
        """Choose the hypothesis to believe from J."""
        cdef Py_ssize_t i, k, following, more, group = -1, count = self.compared.shape[0]
        cdef double worst = -INFINITY, limit, apart, noise
        cdef bint clear, gains
        self.open, self.least = False, INFINITY
        for i in range(count):
            k = self.compared[i]
            self.barred[k] = self.is_barred(k)
            # What only a barred hypothesis explains is no weather, unless the vehicle turns.
            if not self.barred[k] or self.still[k]:
                self.least = min(self.least, self.J[k])
            if self.barred[k]:
                continue
            if self.J[k] > worst or isnan(self.J[k]):
                worst = self.J[k]
                if isnan(worst):
                    break
        # J_k explains the data up to max(score_floor^2, tolerance^2 max_i J_i).
        self.limit = limit = self.share * worst if self.share * worst > self.floor else self.floor
        if self.J[self.believed] <= limit and self.is_remembered(self.believed):
            self.unexplained = 0.0
            return
        following = more = -1
        for i in range(count):
            k = self.compared[i]
            if group >= 0 and self.group[i] > group:
                # Fewer faults explain the data: no need to look at hypotheses with more.
                break
            if self.J[k] <= limit and not self.barred[k]:
                group = self.group[i]
                if self.delivers_more(k):
                    # Two or more actuators that deliver more are explained as others that deliver less, so only one
                    # may. As one of two losses ends, the rest looks for a moment like an actuator that delivers more.
                    if self.faults(k) == 1 and self.mean_J[k] <= AFTER_SEVERAL * limit:
                        more = k if more < 0 or self.J[k] < self.J[more] else more
                elif following < 0 or self.J[k] < self.J[following]:
                    following = k
        if following >= 0 and more >= 0:
            apart = self.mean_J[following] - self.mean_J[more]
            # The lasting means are compared in units of the present noise, or of errors of the model where these are
            # larger.
            noise = min(1.0, max(self.level, self.share))
            gains = apart > self.penalty or apart > 0.0 and self.lasts(more, following, noise * self.penalty)
            # The mean is about to decide: then the choice is not left open.
            clear = self.J[following] - self.J[more] <= self.penalty and (
                self.mean_J[more] < CLEAR * self.mean_J[following]
            )
            # In health every hypothesis explains the data, and the sign of an estimate is noise.
            self.open = not gains and (
                apart > RIVALS_OPEN * self.penalty and worst > self.floor
                or clear and apart > RIVALS_OPEN * noise * self.penalty
                or self.lasts(more, following, RIVALS_OPEN * self.penalty)
            )
            following = more if gains else following
        elif more >= 0:
            following = more
        if following >= 0:
            self.unexplained = 0.0
            following = self.with_second(following)
            if more >= 0 and self.faults(following) == 2:
                # Which single actuator it would be is not asked where two losses explain the data far better.
                apart = self.mean_J[more] - self.mean_J[following]
                self.open = self.open and not (apart > self.penalty or self.lasts(following, more, self.penalty))
            if not self.stays(following, limit):
                if self.faults(following) != self.faults(self.believed):
                    # The means belong to hypotheses with another number of faults: begin them anew.
                    self.mean_J[:] = self.J
                self.believed = following
            return
        following = self.compared[0]
        for i in range(count):
            k = self.compared[i]
            if self.barred[k]:
                continue
            if self.J[k] < self.J[following] or (isnan(self.J[k]) and not isnan(self.J[following])):
                following = k
        self.believed = following
        self.unexplained = sqrt(self.J[following])

    cdef bint lasts(self, Py_ssize_t k, Py_ssize_t other, double apart) noexcept:
        """Return whether what lasts, faults that are still there, is clearly nearer to hypothesis k than to another."""
        cdef Py_ssize_t i
        for i in range(self.spans[k], self.spans[k + 1]):
            if self.scaling[i] and self.fault[i] * self.mean_fault[i] < GONE * self.mean_fault[i] * self.mean_fault[i]:
                return False
        return (
            self.lasting_J[other] - self.lasting_J[k] > apart
            and self.lasting_J[k] < CLEAR * self.lasting_J[other]
        )

    cdef void find_rivals(self, bint explained) noexcept:
        """Find for each channel held responsible the one that may be in its place, -1 where the two are told apart."""
        cdef Py_ssize_t i, k, out, best
        cdef double noise = min(1.0, max(self.level, self.share)), told, apart, nearest
        for out in range(self.rival.shape[0]):
            told, nearest, best = TOLD if self.rival[out] >= 0 else 0.5 * TOLD, INFINITY, -1
            for i in range(self.compared.shape[0] if explained else 0):
                k = self.compared[i]
                if self.exchanged[self.believed, k] != out or self.J[k] > self.limit or self.barred[k]:
                    continue
                if self.faults(k) > 1 and self.delivers_more(k):
                    continue
                apart = max(self.mean_J[k] - self.mean_J[self.believed],
                            self.lasting_J[k] - self.lasting_J[self.believed])
                if apart < told * noise and apart < nearest:
                    nearest, best = apart, self.exchanged[k, self.believed]
            self.rival[out] = best

    cdef inline Py_ssize_t faults(self, Py_ssize_t k) noexcept:
        return self.spans[k + 1] - self.spans[k]

    cdef Py_ssize_t with_second(self, Py_ssize_t single) noexcept:
        """Return the hypothesis of two losses where it explains the data far better than ``single``, else
        ``single``."""
        cdef Py_ssize_t i, k, first, best = single
        cdef double one, other, apart = self.penalty, loyalty
        if self.faults(single) != 1:
            return single
        if not self.delivers_more(single):
            apart = max(apart, SECOND_APART * self.floor)
        for i in range(self.compared.shape[0]):
            k, first = self.compared[i], self.spans[self.compared[i]]
            if self.barred[k] or self.faults(k) != 2 or not (self.scaling[first] and self.scaling[first + 1]):
                continue
            loyalty = LOYALTY if k == self.believed else 1.0
            one, other = -self.fault[first], -self.fault[first + 1]
            if (
                min(one, other) > SECOND_SHARE / loyalty * max(one, other)
                and (self.mean_J[single] - self.mean_J[k] > apart / loyalty or self.lasts(k, single, self.penalty))
                and self.J[k] < self.J[best]
            ):
                best = k
        return best

    cdef bint stays(self, Py_ssize_t best, double limit) noexcept:
        """Return whether the believed hypothesis stays: it explains the data with as few faults and is not clearly
        worse."""
        if self.faults(self.believed) != self.faults(best) or not self.J[self.believed] <= limit:
            return False
        if self.delivers_more(best) != self.delivers_more(self.believed):
            return False
        return not self.J[self.believed] > LOYALTY * self.J[best]

    cdef bint delivers_more(self, Py_ssize_t k) noexcept:
        """Return whether an actuator delivers more than commanded by hypothesis k."""
        cdef Py_ssize_t i
        for i in range(self.spans[k], self.spans[k + 1]):
            # The overshoot of a loss that ends is no gain.
            if self.scaling[i] and self.fault[i] > max(0.0, -self.mean_fault[i]):
                return True
        return False

    cdef bint is_remembered(self, Py_ssize_t k) noexcept:
        """Return whether a washed-out fault that only hypothesis k has was above its threshold one row ago."""
        cdef Py_ssize_t i
        for i in range(self.remembered.shape[0]):
            if self.remembered[i] and self.own[k, self.washed[i]]:
                return True
        return False

    cdef void give_back(self, bint explained, double beyond) noexcept:
        """Invert the washouts of all faults; those of the believed hypothesis become evidence."""
        cdef Py_ssize_t i, j, channel
        cdef double size
        cdef Py_ssize_t holding = 0
        cdef bint is_believed
        cdef Washout washout
        for i in range(self.remembered.shape[0]):
            holding += (<Washout> self.washouts[i]).holds()
        for i in range(self.remembered.shape[0]):
            channel, washout = self.washed[i], <Washout> self.washouts[i]
            is_believed = False
            for j in range(self.spans[self.believed], self.spans[self.believed + 1]):
                is_believed |= self.channel[j] == channel
            if holding <= washout.holds():
                washout.forget_others()
            size = washout.update(self.fault[self.shown[channel]], beyond, is_believed)
            self.remembered[i] = fabs(size) > beyond * washout.threshold
            if explained and is_believed:
                self.evidence[channel] = size

    cdef void watch_edges(self, const double[:, :] fault, Py_ssize_t row, bint complete) noexcept:
        """Set the evidence of sensors to the edges of their estimates; an edge that is held explains the data."""
        cdef Py_ssize_t i, k, column
        cdef double whole
        cdef EdgeDetector detector
        for i in range(self.watched.shape[0]):
            k, column, detector = self.watched[i], self.watched_column[i], <EdgeDetector> self.detectors[i]
            # Before and after an edge the estimate is flat, which it is not in a lively flight: J is judged by health's
            # level.
            whole = self.J[k] * max(1.0, self.level)
            self.evidence[self.channel[column]] = detector.update(fault[row, column], whole, complete)
            if detector.held != 0.0 and self.J[k] <= self.floor:
                self.unexplained = 0.0


cdef class EdgeDetector:
    """Watches the estimate of one sensor's fault for edges: jumps of the sensor, unlike faults of the plant, which
    ramp.

    A sensor's fault is estimated without any assumption about its course, so it can explain anything that its output
    does: the estimate of a gyro bias follows a failing motor, too. A jump of the sensor makes an edge, which a push on
    the plant cannot make: a flat level, then another level within a few samples, more than half of which stays, while
    the hypothesis of this sensor leaves no more unexplained than in healthy flight. The size is held until an opposite
    edge cancels it, at most for ``hold_s``: after that only another sensor could tell the bias. An opposite edge that
    comes later is the end of that fault and no new one. Lines over lost measurements are flat and have corners: an edge
    does not count where more than three in five of the samples around it are bridged.

    Parameters
    ----------
    mean, gap, flat, longest : int
        Rows of the running mean, of the gap between the levels, of a level, and of the longest hold of an edge.
    limit : float
        Largest J with which the hypothesis is believed.
    smallest : float
        Smallest edge that is held; NaN: edges are returned, not held.
    """

    cdef Py_ssize_t mean, gap, longest, size, filled, head, estimated, loud, matched, quiet, age, bridged
    cdef Py_ssize_t middle, after, before
    cdef double limit, smallest
    cdef double[::1] estimates, means
    cdef unsigned char[::1] is_bridged
    cdef double gone
    cdef readonly double edge, held

    def __init__(self, mean, gap, flat, longest, limit, smallest):
        self.mean, self.gap, self.longest, self.limit, self.smallest = mean, gap, longest, limit, smallest
        # Rows back from the newest mean: to the middle and the begin of the second level, to the end of the first
        # level.
        self.middle, self.after, self.before = flat // 2, flat, flat + gap + mean
        self.size = self.before + flat + 1
        self.estimates, self.means = np.zeros(mean), np.zeros(self.size)
        self.is_bridged = np.zeros(self.size, np.uint8)
        self.clear()

    cdef void clear(self) noexcept:
        self.filled = self.head = self.estimated = 0
        self.loud = self.matched = self.quiet = self.age = self.bridged = 0
        self.edge = self.held = self.gone = 0.0
        self.is_bridged[:] = 0

    def run(self, const double[:] estimates, const double[:] J, const unsigned char[:] complete):
        """Return what :meth:`update` returns for each of n rows (n,)."""
        cdef Py_ssize_t k
        if not estimates.shape[0] == J.shape[0] == complete.shape[0]:
            raise ValueError("estimates, J and complete differ in length")
        result = np.empty(estimates.shape[0])
        cdef double[::1] given = result
        for k in range(estimates.shape[0]):
            given[k] = self.update(estimates[k], J[k], complete[k])
        return result

    cdef double update(self, double estimate, double J, bint complete) noexcept:
        """Process one row; return the size that is held, or that of the edge where none is held."""
        cdef double step, before
        self.push(estimate, complete)
        # A J beyond the limit rules out edges until the whole window is later than it.
        self.loud = self.size if self.limit < J else max(0, self.loud - 1)
        self.age += 1
        self.quiet = max(0, self.quiet - 1)
        if self.age > self.longest and self.held != 0.0:
            self.gone, self.held = self.held, 0.0
        step = self.step()
        self.matched = self.matched + 1 if step != 0.0 else 0
        self.edge = step if self.matched >= self.mean and self.quiet == 0 else 0.0
        if isnan(self.smallest):
            return self.edge
        if self.edge != 0.0 and fabs(self.edge) >= self.smallest:
            self.quiet = self.gap + 2 * self.mean
            self.age = 0
            # An edge back to zero ends a fault that came slowly or is no longer held.
            if self.held == 0.0 and fabs(self.back(0)) < EDGE_CANCELLED * fabs(self.edge):
                self.gone = 0.0
                return 0.0
            before = self.held if self.held != 0.0 else self.gone if self.gone * self.edge < 0.0 else 0.0
            self.held, self.gone = before + self.edge, 0.0
            # An edge that leads to the other side by as much does not end the fault.
            if before and fabs(self.held) < EDGE_CANCELLED * min(fabs(self.edge), fabs(before)):
                self.held = 0.0
        return self.held

    cdef void push(self, double estimate, bint complete) noexcept:
        """Append the mean of the newest estimates to the window, and whether the row was bridged."""
        cdef Py_ssize_t i, first
        cdef double total = 0.0
        self.head = (self.head + 1) % self.size
        self.bridged += (not complete) - self.is_bridged[self.head]
        self.is_bridged[self.head] = not complete
        self.estimates[self.estimated % self.mean] = estimate
        self.estimated += 1
        first = max(0, self.estimated - self.mean)
        for i in range(first, self.estimated):
            total += self.estimates[i % self.mean]
        self.means[self.head] = total / (self.estimated - first)
        self.filled = min(self.filled + 1, self.size)

    cdef double step(self) noexcept:
        """Return the step over the gap; zero where a level is not flat, or goes on, or goes back."""
        cdef double step, on
        cdef Py_ssize_t rows
        if self.loud or self.filled < self.size or self.bridged > EDGE_BRIDGED * self.size:
            return 0.0
        for rows in range(self.after, self.before + 1):
            if self.is_bridged[(self.head + self.size - rows) % self.size]:
                return 0.0
        step = self.back(self.after) - self.back(self.before)
        if fabs(self.back(self.before) - self.back(self.size - 1)) >= EDGE_SHARE * fabs(step):
            return 0.0
        for rows in (0, self.middle):
            # Further change since the step, as a share of it and positive in its direction.
            on = (self.back(rows) - self.back(self.after)) / step
            if not -EDGE_FADED < on < EDGE_SHARE:
                return 0.0
        return step

    cdef double back(self, Py_ssize_t rows) noexcept:
        return self.means[(self.head + self.size - rows) % self.size]


cdef class Washout:
    """Inverse of the washout of one fault channel: restores a lasting fault that the washout removes.

    An observer of washed-out positions and angles sees a fault f through the same washout,

        f_w' = f' - f_w / tau,     whose exact inverse is     f = f_w + (1/tau) * integral of f_w dt,

    so a step fades, and the end of the fault shows as a step with the other sign. The inverse would integrate every
    error of healthy operation; so it integrates only while |f_w| is large:

    - no fault (integral zero) and |f_w| <= threshold / 2: f = f_w;
    - |f_w| > threshold / 2: the integral runs (trapezoidal rule), and f = f_w + integral / tau;
    - |f_w| <= threshold / 2 again while f is still large: the fault lasts, fully washed out, and the integral is held
      for ``longest`` rows. After that no measurement supports the fault any more: it is let go, but remembered, so that
      its end, an opposite step of its size, is not taken for a new fault. An integral most of which was gathered while
      a fault that does not wash out explained the measurements is forgotten at once: it is no memory of this one. (That
      of one that does is kept until the other's end, which is an opposite step here, too);
    - a gap, after which all positions begin anew: the fault is held likewise, as if it had been washed out;
    - |f| within the threshold again, or within a tenth of its peak (errors of a tenth leave as much; within half of it
      if the fault may have changed in a gap): the fault is over. The result is zero until |f_w| has stayed small for
      ``settle`` rows (a step down passes through zero); then everything is forgotten.

    Parameters
    ----------
    share : float
        1 / (2 tau rate): the weight of one row of f_w / tau in the trapezoidal rule.
    threshold : float
        Alarm threshold of the channel.
    settle, longest : int
        Rows after which a fault that ended is forgotten, and for which a fault is held without a measurement that
        supports it.
    """

    cdef readonly double threshold, peak
    # The integral, and the part of it that was gathered while another fault was believed.
    cdef double integral, others
    cdef double share, before, gone
    cdef Py_ssize_t settle, longest, still, moving, ended
    # The share of the peak within which the fault is over.
    cdef double left

    def __init__(self, share, threshold, settle, longest):
        self.share, self.threshold, self.settle, self.longest = share, threshold, settle, longest
        self.clear()

    cdef void clear(self) noexcept:
        self.before = self.integral = self.others = self.peak = self.gone = 0.0
        self.still = self.moving = self.ended = 0
        self.left = WASHOUT_OVER

    cdef bint holds(self) noexcept:
        """Return whether a fault was seen, and its end not yet."""
        return self.peak != 0.0 or self.gone != 0.0

    cdef void forget_others(self) noexcept:
        """Forget, once it is small, an integral most of which was gathered while another fault was believed."""
        if self.still and fabs(self.others) > 0.5 * fabs(self.integral):
            self.integral = self.peak = 0.0

    cdef bint resume(self) noexcept:
        """Go on after a gap in which the estimate began anew; return whether a fault is held."""
        cdef bint lasts = self.peak != 0.0 and self.ended == 0
        self.integral = self.before + self.integral if lasts else 0.0
        self.others = 0.0
        self.peak = self.peak if lasts else 0.0
        self.before, self.left = 0.0, WASHOUT_RETURNED
        self.moving = self.ended = 0
        return lasts

    def run(self, const double[:] washed):
        """Return f of each of n rows (n,)."""
        cdef Py_ssize_t k
        result = np.empty(washed.shape[0])
        cdef double[::1] fault = result
        for k in range(washed.shape[0]):
            fault[k] = self.update(washed[k], 1.0, True)
        return result

    cdef double update(self, double washed, double beyond, bint is_believed) noexcept:
        """Process one row's estimate f_w, whether this or another fault is believed; return f = f_w + integral / tau.

        ``beyond`` is the factor by which errors, and so the threshold, are larger outside of the fitted flights.
        """
        cdef double threshold = beyond * self.threshold
        cdef bint moves = fabs(washed) > WASHOUT_QUIET * threshold, over
        cdef double fault, size, gained = self.share * (washed + self.before)
        if moves:
            self.integral += gained
            self.others += 0.0 if is_believed else gained
        if self.integral == 0.0:
            self.others = 0.0
        self.still, self.moving = 0 if moves else self.still + 1, self.moving + 1 if moves else 0
        self.before = washed
        fault = washed + self.integral
        size = fabs(fault)
        if moves and self.returns(fault, threshold):
            return 0.0
        if self.peak == 0.0:
            self.left = WASHOUT_OVER
        if size > threshold and size > self.peak:
            self.peak = size
        over = size <= max(threshold, self.left * self.peak)
        if not moves and not over and self.still >= self.longest:
            # While held the integral did not change, but this row may already belong to the end of the fault.
            self.gone += self.integral
            self.integral = self.peak = 0.0
            return washed
        self.ended = self.ended + 1 if over and not moves else 0
        if self.ended and (self.peak == 0.0 or self.ended > self.settle):
            self.integral = self.peak = 0.0
            return washed
        return 0.0 if over and self.peak > 0.0 else fault

    cdef bint returns(self, double fault, double threshold) noexcept:
        """Return whether a fault is the end of one that was let go, or may become it."""
        cdef double left = fabs(fault + self.gone), size = fabs(self.gone)
        if fault * self.gone >= 0.0:
            return False
        if self.moving <= self.settle:
            return left < size
        if left <= max(threshold, WASHOUT_RETURNED * size):
            # The end of the fault: zero until the washed-out estimate has settled.
            self.integral, self.peak, self.gone = self.integral - fault, size, 0.0
            return True
        return False


cdef class IndependentIsolation:
    """Every channel's smoothed estimate is its own evidence.

    Parameters
    ----------
    channels : int
        Number of channels a.
    keep : float
        Weight of the smoothed estimate before a row.
    """

    cdef double keep
    cdef double[::1] smoothed

    def __init__(self, channels, keep):
        self.keep = keep
        self.smoothed = np.zeros(channels)

    def run(self, const double[:, :] fault, const unsigned char[:] measured, const unsigned char[:] restart):
        """Return the evidence of each of n rows (n, a); one that is neither measured nor a restart changes nothing."""
        cdef Py_ssize_t k, i, a = self.smoothed.shape[0]
        if fault.shape[1] != a or not fault.shape[0] == measured.shape[0] == restart.shape[0]:
            raise ValueError(f"fault, measured and restart do not fit together or are not of {a} channels")
        result = np.empty((fault.shape[0], a))
        cdef double[:, ::1] evidence = result
        for k in range(fault.shape[0]):
            if restart[k]:
                self.smoothed[:] = 0.0
            if measured[k] or restart[k]:
                for i in range(a):
                    self.smoothed[i] = self.keep * self.smoothed[i] + (1.0 - self.keep) * fault[k, i]
            evidence[k, :] = self.smoothed
        return result
