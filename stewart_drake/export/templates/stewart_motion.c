/* The motion as polynomials of fifth order between instants: pose, rates and accelerations there are
   those of the scenario, in between they differ by less than @"%g" % motion_tolerance@ of their size. */

#include "stewart_motion.h"

const double stewart_duration = @scenario.duration|float@;
#define KNOTS @motion|length@
static const double motion[KNOTS][1 + STEWART_REFERENCE] = {
    @motion|exact_rows@};

/* The row at t of a number of knots. */
static void along(int number, const double (*knots)[1 + STEWART_REFERENCE], double t, real *reference)
{
    int low = 0, high = number - 1;
    t = t > knots[low][0] ? t : knots[low][0]; /* and for NaN */
    t = t < knots[high][0] ? t : knots[high][0];
    while (high - low > 1) {
        int middle = (low + high) / 2;
        *(knots[middle][0] <= t ? &low : &high) = middle;
    }
    const double *a = knots[low] + 1, *b = knots[high] + 1;
    double h = knots[high][0] - knots[low][0], s = (t - knots[low][0]) / h;
    for (int i = 0; i < 6; i++) {
        /* c0 + c1 s + ... + c5 s^5 with these values, slopes and curvatures at s = 0 and 1 */
        double v0 = h * a[6 + i], v1 = h * b[6 + i], a0 = h * h * a[12 + i], a1 = h * h * b[12 + i];
        double c2 = a0 / 2, d = b[i] - a[i] - v0 - c2, e = v1 - v0 - a0, f = a1 - a0;
        double c3 = 10 * d - 4 * e + f / 2, c4 = -15 * d + 7 * e - f, c5 = 6 * d - 3 * e + f / 2;
        reference[i] = (real)(a[i] + s * (v0 + s * (c2 + s * (c3 + s * (c4 + s * c5)))));
        reference[6 + i] =
            (real)((v0 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h);
        reference[12 + i] = (real)((2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / (h * h));
    }
}

void stewart_reference(double t, real *reference) { along(KNOTS, motion, t, reference); }
{% if goal is none %}
void stewart_goal(double t, real *reference) { stewart_reference(t, reference); }
{% else %}

static const double goal[@goal|length@][1 + STEWART_REFERENCE] = {
    @goal|exact_rows@};

void stewart_goal(double t, real *reference) { along(@goal|length@, goal, t, reference); }
{% endif %}

void stewart_look_ahead(void *context, int number, const real *times, real *rows)
{
    for (int i = 0; i < number; i++)
        stewart_reference(*(const double *)context + (double)times[i], rows + STEWART_REFERENCE * i);
}

void stewart_look_back(void *context, int number, const real *times, real *rows)
{
    for (int i = 0; i < number; i++)
        stewart_goal(*(const double *)context + (double)times[i], rows + STEWART_REFERENCE * i);
}
