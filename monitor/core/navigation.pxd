# cython: language_level=3
"""The declarations of the navigation, and of headings, for the strapdown transform."""

from libc.math cimport M_PI, fabs, floor

# Headings are compared up to this cosine of the pitch, 60 degrees, where errors of the attitude count twice; beyond it
# they grow without bound, and at the vertical there is no heading.
cdef inline bint is_steep(double cosine) noexcept:
    return fabs(cosine) < 0.5


cdef inline double wrapped(double angle) noexcept:
    """Return an angle in radians between -pi and pi."""
    return angle - 2.0 * M_PI * floor((angle + M_PI) / (2.0 * M_PI))


cdef inline void cross(const double* a, const double* b, double* product) noexcept:
    cdef int j
    for j in range(3):
        product[j] = a[(j + 1) % 3] * b[(j + 2) % 3] - a[(j + 2) % 3] * b[(j + 1) % 3]


cdef inline double along(const double* R, const double* v, int axis) noexcept:
    """Return the component of a body vector along an axis (north, east, down) at an attitude R."""
    return R[3 * axis] * v[0] + R[3 * axis + 1] * v[1] + R[3 * axis + 2] * v[2]


cdef inline double field_rate(const double* R, const double* rate, const double* field) noexcept:
    """Return the rotation about the vertical, rad/s, by which a field's direction is off per second of delay."""
    cdef double[3] turned
    cdef double north = along(R, field, 0), east = along(R, field, 1), square = north * north + east * east
    cross(rate, field, turned)
    # A vertical field, and the zeros of a magnetometer that is not there, have no direction.
    return (east * along(R, turned, 0) - north * along(R, turned, 1)) / square if square > 0.0 else 0.0


cdef enum:
    STATES = 14
    # Gyros x, y, z, then accelerometers x, y, z.
    BIASES = 6
    HYPOTHESES = 11
    ONSETS = 30


cdef struct Signature:
    # What a fault of unit size adds to the state, by state and hypothesis.
    double[STATES][HYPOTHESES] state
    double[HYPOTHESES] matched
    double[HYPOTHESES] energy
    # Biases of gyros and accelerometers at the onset, and their variances.
    double[BIASES] bias
    double[BIASES] variance
    # Time since the onset, s.
    double age_s


cdef struct Coast:
    # The filter's state minus that of navigation without the GPS since the coast began; the covariance of the latter;
    # time since then, s (0: it has not begun).
    double[STATES] led
    double[STATES][STATES] P
    double age_s


cdef class Navigation:
    cdef double _dt, _level
    cdef int _every, _ticks, _count, _helpless
    # Ticks since the newest fix, and between it and the one before.
    cdef int _unseen, _pace
    # Time since the fix before, s.
    cdef double _step_s
    # Whether it has begun; whether the autopilot's heading is not used.
    cdef bint _begun, _turned
    cdef double[9] _R
    cdef double[3] _rate
    cdef double[3] _force
    # Of gyros, then accelerometers: the change over the tick before, and the variance of the noise.
    cdef double[6] _change
    cdef double[6] _noise
    # The force in the body's axes at the gyros' time; its change per second of delay, north, east, down; that delay.
    cdef double[3] _aligned
    cdef double[3] _swing
    cdef double _late_s
    cdef double[2] _velocity
    # Error of the GPS's velocity, its growth per second, and whether it ramps. Newest innovations of velocity and field
    # that may be steps, and for how many comparisons they have been.
    cdef double[2] _offset
    cdef double[2] _drift
    cdef bint[2] _led
    cdef double[3] _stepped
    cdef Coast[2] _coasts
    cdef int[3] _held
    # The magnetic field: fitted delay behind the gyros, its timing error, noise and random walk of its direction; its
    # direction from north; estimated declination and usual strength; how long it has been as before since a jump, and
    # its direction then; estimated delay; largest rate of late.
    cdef double _field_delay_s, _field_timing_s, _field_noise, _field_walk, _direction, _declined, _strength
    cdef double _back_s, _back_off, _field_late_s, _whirl
    # For how much longer a field may be older than its tick, as measurements were lost.
    cdef double _lined_s
    # Whether a gyro was faulty, whose bias an estimator may have learned.
    cdef bint _learned
    cdef double[3] _field
    cdef double[2] _tilting
    cdef double _turning
    cdef bint _pointed, _aimed
    # The largest horizontal acceleration of late; the variance of the noise of the GPS's velocity; its innovations
    # north and east in the last two comparisons.
    cdef double _sharp, _speed_noise
    cdef double[2][2] _off
    cdef double[3] _missed
    # Of gyros and accelerometers: biases; biases before a fault, their variances, and their errors' covariances with
    # those of the state now; by what share the variance of a fault's size is larger, as the onset is not known; whether
    # there is a fault.
    cdef double[BIASES] _bias
    cdef double[BIASES] _before
    cdef double[BIASES] _doubt
    cdef double[STATES * BIASES] _shared
    cdef double[BIASES] _unsure
    cdef bint[BIASES] _faulty
    cdef double[STATES][STATES] _P
    cdef double[STATES][STATES] _F
    cdef double[STATES][STATES] _Q
    # Those of the onsets, in the order of ``_order``, the newest first.
    cdef Signature[ONSETS] _signatures
    cdef int[ONSETS] _order
    cdef readonly double score
    # Whether the magnetic field has jumped and is not back yet.
    cdef bint strayed
    # Whether a ramp of the GPS's velocity has ended: washed-out values from before are void. Whether the filter began
    # anew after a gyro's fault: those that contain accelerations are.
    cdef bint returned, renewed

    cdef void restart(self) noexcept
    cdef void go_on(
        self, const double* force, const double* rate, const double* mean, const double* R, const double* field,
        const double* hidden, bint lined, double ahead, double* acceleration
    ) noexcept
    cdef bint due(self, double measured) noexcept
    cdef void align(self, const double* force, const double* rate, double* aligned, double* swing) noexcept
    cdef void shake(self, int k, double change) noexcept
    cdef void scatter(self, double second, double variance) noexcept
    cdef double shaken(self, int axis, int first) noexcept
    cdef void point(self, const double* field, const double* R) noexcept
    cdef void meet(self, const double* velocity, double line_s, bint consistent) noexcept
    cdef bint believed(self) noexcept
    cdef double field_spread(self) noexcept
    cdef bint steps(self, int m, double off, double variance, double least) noexcept
    cdef void put_off(self, int m, double size) noexcept
    cdef bint leads_back(self, int m, double size) noexcept
    cdef void coast(self) noexcept
    cdef double fault(self, int which) noexcept
    cdef double spread(self, int which) noexcept
    cdef double pointing(self) noexcept
    cdef void differ(self, const double* R, double* apart) noexcept
    cdef double missed(self, int axis) noexcept
    cdef double led(self, int axis) noexcept
    cdef void begin(self, const double* R) noexcept
    cdef void propagate(self) noexcept
    cdef void carry(self, double* x, int count, int (*columns)[STATES], const int* used) noexcept
    cdef void spread_by(self, double (*P)[STATES], int (*columns)[STATES], const int* used) noexcept
    cdef void turn_field(self, double* H) noexcept
    cdef void update(self, const double* innovation, const double* variance) noexcept
    cdef void judge(self) noexcept
    cdef double onset_spread(self, int which, int n, double size, double best) noexcept
    cdef void end(self, Signature* signature, int which) noexcept
    cdef void jump(self, Signature* signature, int which, double size, double spread) noexcept
    cdef void correct(self, const double* x) noexcept
    cdef Signature* signature(self, int k) noexcept
    cdef int onsets(self) noexcept
    cdef void advance(self, double* m, int apart, const double* f) noexcept
