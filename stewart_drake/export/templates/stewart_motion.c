/* The motion of the scenario, see motion.h. */

#include "motion.h"
#include "stewart_motion.h"

const double stewart_duration = @scenario.duration|float@;

{% for definition in motion.before %}
@definition@
{% endfor %}
static const stewart_known_motion motions = @motion.text@;

void stewart_reference(double t, real *reference)
{
    stewart_rows_of_motion(motions.planned, 1, &t, reference);
}

void stewart_goal(double t, real *reference) { stewart_rows_of_motion(motions.goal, 1, &t, reference); }

void stewart_look_ahead(void *context, int number, const real *times, real *rows)
{
    stewart_known_motion known = motions;
    known.now = *(const double *)context;
    stewart_planned_rows(&known, number, times, rows);
}

void stewart_look_back(void *context, int number, const real *times, real *rows)
{
    stewart_known_motion known = motions;
    known.now = *(const double *)context;
    stewart_goal_rows(&known, number, times, rows);
}
