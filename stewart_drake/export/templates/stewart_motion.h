/* The motion of the scenario. */

#pragma once

#include "law.h"

extern const double stewart_duration; /* s */

/* The reference at t: pose, rates, accelerations. Before 0 it is that at 0, and for NaN too. */
void stewart_reference(double t, real *reference);

/* The same motion without its catch-up from rest: plans lead back to it. */
void stewart_goal(double t, real *reference);

/* For `.reference` and `.goal` of a sample. `.context` points to the time of the sample, a double in s. */
void stewart_look_ahead(void *context, int number, const real *times, real *rows);
void stewart_look_back(void *context, int number, const real *times, real *rows);
