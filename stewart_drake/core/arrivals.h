/* Which torque acts when, for a delay of any length that may drift. */

#pragma once

#include "machine.h"

#ifdef STEWART_FLOAT
#define STEWART_INSTANT 1e-6f /* s; arrivals closer than this are one */
#else
#define STEWART_INSTANT 1e-9
#endif

/* Seen from an instant 0. Torques arriving then have the delay eta, of rate r. A torque sent at i dt
   that arrives at a has the delay eta + r a, so to first order of r

       a_i = (i dt + eta) (1 + r).

   It acts until the next one arrives. Torques sent before t = 0 act until the first of the
   controller's own arrives; they are known by the torque in each period from now on. */
typedef struct {
    real period; /* dt, s */
    real eta;    /* of a torque that arrives now, s; infinite for none ever */
    real rate;   /* of eta, s/s */
    int sent;    /* number of torques in flight that are the controller's own, the newest */
    int before;  /* number of `others` */
    const real *others; /* (before, 6) N m, the torque of each period without own ones; the last stays */
} stewart_arrivals;

/* Upper bound of the torques in a schedule up to an instant, s from now. */
int stewart_arrivals_most(const stewart_arrivals *arrivals, real end);

/* Instants in (begin, end) at which another torque begins to act, ascending; returns their number.
   `newest` is i of the last torque: -1 before a sample's torque is computed, 0 after it. */
int stewart_switches(const stewart_arrivals *arrivals, real begin, real end, int newest, real *at);

/* Torque schedule between two instants: torques (n, 6) and durations (n); returns n. `in_flight`
   (flights, 6) has the oldest first; only the last `sent` count. */
int stewart_within(const stewart_arrivals *arrivals, int flights, const real *in_flight, real begin,
                   real end, int newest, real *torques, real *durations);
