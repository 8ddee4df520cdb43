/* DOP853: the explicit Runge-Kutta method of order 8 of Dormand and Prince with the error estimates of
   order 5 and 3 and the polynomial of order 7 of Hairer, Norsett and Wanner (Solving Ordinary
   Differential Equations I, sections II.4 to II.6 and II.10). No state but the caller's. */

#include <float.h>
#include <math.h>
#include <string.h>

#include "dop853.h"
#include "dop853_table.h"

#define LAST 12 /* the stage at the end of a step, which is the first of the next one */

/* x + h (sum of a row's slopes). */
static void combine(const dop853 *s, const double *row, int stages, double h, double *x)
{
    double sum[STATES] = {0.};
    for (int j = 0; j < stages; j++)
        if (row[j] != 0.)
            for (int i = 0; i < STATES; i++)
                sum[i] += row[j] * s->slopes[j][i];
    for (int i = 0; i < STATES; i++)
        x[i] = s->start[i] + h * sum[i];
}

static void stage(dop853 *s, int number, double h, double *x)
{
    combine(s, A[number], number, h, x);
    s->slope(s->system, x, s->slopes[number]);
    s->evaluations++;
}

/* Tolerance of the error of one number, with values x and y at both ends of the step. */
static double scale(const dop853 *s, double x, double y)
{
    return s->tolerance * (1. + fmax(fabs(x), fabs(y)));
}

/* Root mean square in units of the tolerance. */
static double norm(const dop853 *s, const double *values)
{
    double sum = 0.;
    for (int i = 0; i < STATES; i++) {
        double ratio = values[i] / scale(s, s->x[i], 0.);
        sum += ratio * ratio;
    }
    return sqrt(sum / STATES);
}

/* Estimate the first step from the slope, and its change over a step of Euler's method (section II.4). */
static double first_step(dop853 *s)
{
    double slope[STATES], x[STATES], change[STATES];
    const double *now = s->slopes[LAST];
    double d0 = norm(s, s->x), d1 = norm(s, now);
    double h = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    for (int i = 0; i < STATES; i++)
        x[i] = s->x[i] + h * now[i];
    s->slope(s->system, x, slope);
    s->evaluations++;
    for (int i = 0; i < STATES; i++)
        change[i] = (slope[i] - now[i]) / h;
    double most = fmax(d1, norm(s, change));
    double guess = most <= 1e-15 ? fmax(1e-6, 1e-3 * h) : pow(0.01 / most, 1. / 8.);
    return fmin(100. * h, guess);
}

void dop853_begin(dop853 *s)
{
    s->slope(s->system, s->x, s->slopes[LAST]);
    s->evaluations++;
    if (s->next_step == 0.)
        s->next_step = first_step(s);
}

/* Error of a step of length h to x in units of the tolerance: |e5|^2 / sqrt(|e5|^2 + 0.01 |e3|^2), from the
   estimates of order 5 and 3. */
static double error(const dop853 *s, double h, const double *x)
{
    double of5 = 0., of3 = 0.;
    for (int i = 0; i < STATES; i++) {
        double e5 = 0., e3 = 0., unit = scale(s, s->start[i], x[i]);
        for (int j = 0; j < LAST; j++) {
            e5 += E5[j] * s->slopes[j][i];
            e3 += E3[j] * s->slopes[j][i];
        }
        of5 += e5 / unit * (e5 / unit);
        of3 += e3 / unit * (e3 / unit);
    }
    double both = of5 + 0.01 * of3;
    return both == 0. ? 0. : h * of5 / sqrt(both * STATES);
}

int dop853_step(dop853 *s, double end)
{
    double x[STATES], largest_factor = 6.; /* of one step to the next */
    s->before = s->time;
    memcpy(s->start, s->x, sizeof x);
    memcpy(s->slopes[0], s->slopes[LAST], sizeof x);
    s->has_polynomial = 0;
    for (;;) {
        /* Steps of one length up to the end, so that the last is not a short one. */
        double left = end - s->before, most = s->next_step;
        double parts = ceil(left / most * (1. - 1e-9)), h = parts > 1. ? left / parts : left;
        if (!(most > 16. * DBL_EPSILON * fmax(1., fabs(s->before))))
            return 0;
        for (int number = 1; number < LAST; number++)
            stage(s, number, h, x);
        combine(s, A[LAST], LAST, h, x);
        double wrong = error(s, h, x);
        double factor = wrong == 0. ? largest_factor : 0.9 * pow(wrong, -1. / 8.);
        if (wrong <= 1.) {
            s->time = parts > 1. ? s->before + h : end;
            memcpy(s->x, x, sizeof x);
            s->slope(s->system, x, s->slopes[LAST]);
            s->evaluations++;
            s->steps++;
            /* A step that `end` cut short does not shorten the next one. */
            s->next_step = factor < largest_factor ? h * factor : fmax(h * largest_factor, s->next_step);
            return 1;
        }
        s->next_step = h * (factor >= 0.2 ? fmin(factor, 0.9) : 0.2); /* 0.2 if the factor is NaN */
        largest_factor = 1.; /* after a rejected step */
    }
}

/* x(t) = start + u (p0 + (1-u) (p1 + u (p2 + (1-u) (p3 + ...)))), u = (t - before) / h: the ends, the
   slopes there, and four conditions more. */
static void find_polynomial(dop853 *s)
{
    double h = s->time - s->before, x[STATES];
    for (int number = LAST + 1; number < STAGES; number++)
        stage(s, number, h, x);
    for (int i = 0; i < STATES; i++) {
        double rise = s->x[i] - s->start[i], first = h * s->slopes[0][i];
        s->within[0][i] = rise;
        s->within[1][i] = first - rise;
        s->within[2][i] = 2. * rise - first - h * s->slopes[LAST][i];
        for (int k = 0; k < 4; k++) {
            double sum = 0.;
            for (int j = 0; j < STAGES; j++)
                sum += D[k][j] * s->slopes[j][i];
            s->within[3 + k][i] = h * sum;
        }
    }
    s->has_polynomial = 1;
}

void dop853_at(dop853 *s, double time, double *x)
{
    if (time == s->time) {
        memcpy(x, s->x, sizeof s->x);
        return;
    }
    if (!s->has_polynomial)
        find_polynomial(s);
    double u = (time - s->before) / (s->time - s->before), v = 1. - u;
    for (int i = 0; i < STATES; i++) {
        double sum = 0.;
        for (int k = 6; k >= 0; k--)
            sum = (sum + s->within[k][i]) * (k % 2 ? v : u);
        x[i] = s->start[i] + sum;
    }
}
