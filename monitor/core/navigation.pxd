# cython: language_level=3
"""What the strapdown transform uses of the navigation, and what both take a heading for."""

from libc.math cimport M_PI, fabs, floor

# Cosine of the pitch from which on a heading is not compared: errors of the attitude count twice in it at 60 degrees,
# and beyond it without bound; at the vertical a heading is none.
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
    """Return how far a vector of the body points along an axis, north, east or down, of an attitude R."""
    return R[3 * axis] * v[0] + R[3 * axis + 1] * v[1] + R[3 * axis + 2] * v[2]


cdef inline double field_rate(const double* R, const double* rate, const double* field) noexcept:
    """Return by how much a field that is later, measured in body axes, turns about the vertical, rad per second."""
    cdef double[3] turned
    cdef double north = along(R, field, 0), east = along(R, field, 1)
    cross(rate, field, turned)
    return (east * along(R, turned, 0) - north * along(R, turned, 1)) / (north * north + east * east)


cdef enum:
    STATES = 13
    HYPOTHESES = 10
    ONSETS = 30


cdef struct Signature:
    double[HYPOTHESES][STATES] state
    double[HYPOTHESES] matched
    double[HYPOTHESES] energy
    # biases of gyros and accelerometers at the onset, and their variances
    double[5] bias
    double[5] variance
    # how long ago it was, s
    double age_s


cdef class Navigation:
    cdef double _dt, _level
    cdef int _every, _ticks, _count, _helpless
    # time since the fix before, s
    cdef double _step_s
    # whether it has begun, and whether the autopilot's heading is another one
    cdef bint _begun, _turned
    cdef double[9] _R
    cdef double[3] _rate
    cdef double[3] _force
    # Of the gyros and then of the accelerometers: by how much each changed over the tick before, and the variance of
    # its noise.
    cdef double[6] _change
    cdef double[6] _noise
    # The force in the axes of the gyros, how it turns with them, north, east, down, and how late they are.
    cdef double[3] _aligned
    cdef double[3] _swing
    cdef double _late_s
    cdef double[2] _velocity
    # By how much the GPS's velocity is off, by how much more each second, and whether it ramped there; how far the
    # newest velocity or field was off that may be a step, and for how many of them that has been so.
    cdef double[2] _offset
    cdef double[2] _drift
    cdef bint[2] _led
    cdef double[3] _stepped
    cdef int[3] _held
    # The magnetic field: its measurement, where it points from north, what is taken for its declination and for its
    # strength, for how long it has been so again after it jumped, and how errors of the attitude about north and east
    # and a delay turn it; how late it is against the gyros, as fitted and as found; the largest rate of late.
    cdef double _field_delay_s, _field_timing_s, _field_noise, _field_walk, _direction, _declined, _strength
    cdef double _back_s, _back_off, _field_late_s, _whirl
    # for how long the IMU has lacked; for how long yet a field may be older than its tick, as measurements were lost
    cdef double _lined_s
    # whether a gyro was at fault, whose bias an estimator may have learned
    cdef bint _learned
    cdef double[3] _field
    cdef double[2] _tilting
    cdef double _turning
    cdef bint _pointed, _aimed
    # The largest horizontal acceleration of late; the variance of the noise of the GPS's velocity, and how far that was
    # off north and east in the newest two comparisons.
    cdef double _sharp, _speed_noise
    cdef double[2][2] _off
    cdef double[3] _missed
    # Biases: of the gyros x, y, z, of the accelerometers x, y; what each was before a fault, the variance of that, and
    # whether it has one.
    cdef double[5] _bias
    cdef double[5] _before
    cdef double[5] _doubt
    cdef bint[5] _faulty
    cdef double[STATES][STATES] _P
    cdef double[STATES][STATES] _F
    cdef double[STATES][STATES] _Q
    cdef Signature[ONSETS] _signatures
    cdef readonly double score
    # Whether the magnetic field jumped and has not come back.
    cdef bint strayed
    # Whether a ramp of the GPS's velocity or the trace of a gyro's fault is over: what was washed out then is void.
    cdef bint returned

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
    cdef void meet(self, const double* velocity, double line_s) noexcept
    cdef bint believed(self) noexcept
    cdef double field_spread(self) noexcept
    cdef bint steps(self, int m, double off, double variance, double least) noexcept
    cdef void put_off(self, int m, double size) noexcept
    cdef double fault(self, int which) noexcept
    cdef double spread(self, int which) noexcept
    cdef void differ(self, const double* R, double* apart) noexcept
    cdef double missed(self, int axis) noexcept
    cdef double led(self, int axis) noexcept
    cdef void begin(self, const double* R) noexcept
    cdef void propagate(self) noexcept
    cdef void turn_field(self, double* H) noexcept
    cdef void update(self, const double* innovation, const double* variance) noexcept
    cdef void judge(self) noexcept
    cdef void end(self, Signature* signature, int which) noexcept
    cdef void jump(self, Signature* signature, int which, double size, double spread) noexcept
    cdef void correct(self, const double* x) noexcept
    cdef int onsets(self) noexcept
    cdef void advance(self, double* m, int apart, const double* f) noexcept
