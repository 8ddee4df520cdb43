#include "motion.h"
#include "short.h"

#define LATEST 1e15 /* s; keeps the phase of a wave finite */

static void wave(const stewart_motion *motion, double time, int orders, double *values)
{
    double waves[2] = {0}; /* sine and cosine, in most motions the same for all coordinates */
    for (int i = 0; i < 6; i++) {
        double size = motion->amplitude[i];
        if (i == 0 || motion->frequency[i] != motion->frequency[i - 1]) {
            double phase = motion->frequency[i] * time;
            waves[0] = sin(phase), waves[1] = cos(phase);
        }
        for (int k = 0; k < orders; k++, size *= motion->frequency[i])
            values[6 * k + i] = (k & 2 ? -size : size) * waves[k & 1];
        values[i] += motion->offset[i];
    }
}

/* Horner's rule for the polynomial and its derivatives over k!:  p <- p s + c,  p' <- p' s + p. */
static void polynomial(const stewart_motion *motion, int piece, double s, int orders, double *values)
{
    const double *c = motion->coefficients + 6 * piece;
    for (int n = 0; n < 6 * orders; n++)
        values[n] = 0;
    for (int k = 0; k <= motion->degree; k++, c += 6 * motion->pieces)
        for (int i = 0; i < 6; i++) {
            for (int n = orders - 1; n > 0; n--)
                values[6 * n + i] = values[6 * n + i] * s + values[6 * (n - 1) + i];
            values[i] = values[i] * s + c[i];
        }
    double factorial = 1;
    for (int n = 2; n < orders; n++) {
        factorial *= n;
        for (int i = 0; i < 6; i++)
            values[6 * n + i] *= factorial;
    }
}

void stewart_derivatives_of_motion(const stewart_motion *motion, double time, int orders, double *values)
{
    time = time > 0 ? fmin(time, LATEST) : 0; /* and for NaN */
    while (motion->then && time >= motion->times[motion->pieces])
        motion = motion->then;
    int low = 0, high = motion->pieces;
    if (high == 0 || time >= motion->times[high]) {
        wave(motion, time, orders, values);
        return;
    }
    while (high - low > 1) {
        int middle = (low + high) / 2;
        *(motion->times[middle] <= time ? &low : &high) = middle;
    }
    double s = time - motion->times[low];
    polynomial(motion, low, s > 0 ? s : 0, orders, values);
}

static void row_at(const stewart_motion *motion, double time, real *row)
{
    double values[ROW];
    stewart_derivatives_of_motion(motion, time, 3, values);
    for (int i = 0; i < ROW; i++)
        row[i] = (real)values[i];
}

void stewart_rows_of_motion(const stewart_motion *motion, int number, const double *times, real *rows)
{
    for (int i = 0; i < number; i++)
        row_at(motion, times[i], rows + ROW * i);
}

static void ahead(const stewart_motion *motion, double now, int number, const real *times, real *rows)
{
    for (int i = 0; i < number; i++)
        row_at(motion, now + (double)times[i], rows + ROW * i);
}

void stewart_planned_rows(void *context, int number, const real *times, real *rows)
{
    const stewart_known_motion *known = context;
    ahead(known->planned, known->now, number, times, rows);
}

void stewart_goal_rows(void *context, int number, const real *times, real *rows)
{
    const stewart_known_motion *known = context;
    ahead(known->goal, known->now, number, times, rows);
}
