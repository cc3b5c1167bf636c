/* The observer's recursion in C, to compare with: [s+; estimates] = step [s; v; y; 1; sin(nu)], nu = arguments [s; v; y; 1].
   Matrices by columns (step: columns of `rows` numbers), so that the inner loops run along memory. */
#include <math.h>
#include <string.h>

enum { LARGEST = 1024 };

int run(long ns, long s, long p, long m, long rows, const double *step, const double *arguments, double *state,
        const double *v, const double *y, long count, double *out)
{
    const long known = ns + s + p + 1, columns = known + m;
    double z[LARGEST], total[LARGEST], nu[LARGEST];

    if (columns > LARGEST || rows > LARGEST)
        return 1;
    memcpy(z, state, ns * sizeof *z);
    z[known - 1] = 1.0;
    for (long k = 0; k < count; k++) {
        memcpy(z + ns, v + k * s, s * sizeof *z);
        memcpy(z + ns + s, y + k * p, p * sizeof *z);
        if (m) {
            memset(nu, 0, m * sizeof *nu);
            for (long j = 0; j < known; j++)
                for (long i = 0; i < m; i++)
                    nu[i] += arguments[j * m + i] * z[j];
            for (long i = 0; i < m; i++)
                z[known + i] = sin(nu[i]);
        }
        memset(total, 0, rows * sizeof *total);
        for (long j = 0; j < columns; j++) {
            const double *restrict column = step + j * rows;
            const double factor = z[j];
            for (long i = 0; i < rows; i++)
                total[i] += column[i] * factor;
        }
        memcpy(z, total, ns * sizeof *z);
        memcpy(out + k * (rows - ns), total + ns, (rows - ns) * sizeof *out);
    }
    memcpy(state, z, ns * sizeof *z);
    return 0;
}
