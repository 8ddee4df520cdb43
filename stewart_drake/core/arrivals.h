/* Torque schedules under a delay that may drift. */

#pragma once

#include "machine.h"

#ifdef STEWART_FLOAT
#define STEWART_TIME_TOLERANCE 1e-6f /* s; arrivals closer than this are one */
#else
#define STEWART_TIME_TOLERANCE 1e-9
#endif

/* Time 0 is now. A torque that arrives now has the delay eta, which changes at the rate r. A torque sent
   at i dt that arrives at a_i has the delay eta + r a_i, so to first order of r

       a_i = (i dt + eta) (1 + r).

   It acts until the next one arrives. Until the first of the controller's own torques arrives, the
   torques in `other_torques` act, one per period from now. */
typedef struct {
    real period;    /* dt, s */
    real eta;       /* of a torque that arrives now, s; STEWART_NO_ARRIVAL or more (delay.h): none arrives */
    real rate;      /* of eta, s/s */
    int num_own;    /* number of the controller's own torques in flight, the newest ones */
    int num_others; /* number of `other_torques` */
    const real *other_torques; /* (num_others, 6) N m, one per period; the last one stays */
} stewart_arrivals;

/* Upper bound of the number of torques in a schedule that ends at `end`, s from now. */
int stewart_max_torques(const stewart_arrivals *arrivals, real end);

/* Times in (begin, end) at which another torque begins to act, ascending; returns their number. `at` has
   places for stewart_max_torques(arrivals, end) - 1. `newest` is i of the last torque: -1 before a
   sample's torque is computed, 0 after it. */
int stewart_switch_times(const stewart_arrivals *arrivals, real begin, real end, int newest, real *at);

/* Torque schedule from `begin` to `end`: torques (n, 6) and durations (n); returns n. Both have places
   for n = stewart_max_torques(arrivals, end). `in_flight` (num_in_flight, 6) has the oldest torque first;
   only the last `num_own` count. */
int stewart_torque_schedule(const stewart_arrivals *arrivals, int num_in_flight, const real *in_flight, real begin,
                            real end, int newest, real *torques, real *durations);
