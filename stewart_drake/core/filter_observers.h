/* Observers with a filter, for a known delay. Their memory is an estimate, the last measurement, and the
   number of periods for which the code of each leg has been constant. */

#pragma once

#include "filter.h"
#include "observers.h"

#define STEWART_LEG_GATE 30 /* largest squared residual of a leg, over its variance, that is used */

/* Settings at `law->estimation`. In `filter`, leave machine, sensing and legs unset: the observer fills
   them in from the law. */
typedef struct {
    stewart_filter filter;
    const real *prior; /* (p) initial estimate of the parameters */
} stewart_filter_settings;

extern const stewart_observer stewart_filter_observer;  /* of the measured state */
extern const stewart_observer stewart_gap_observer;     /* the same, re-linearised over gaps */
extern const stewart_observer stewart_encoder_observer; /* of encoders */

extern const stewart_legs stewart_encoder_legs; /* filter step with encoders, see filter_attempt.h */

/* Callbacks of `stewart_observer` that these observers share: size of the memory, scratch numbers of
   `observe`, start from the prior, one period of the filter, restart with the estimated parameters,
   parameters with their standard deviations, and the covariance. */

int stewart_filtered_memory(const stewart_law *law);
int stewart_filtered_scratch(const stewart_law *law);
void stewart_filtered_start(const stewart_law *law, real *memory);
int stewart_filtered_observe(const stewart_law *law, real *memory, int number, const real *torques,
                             const real *values, stewart_scratch scratch);
void stewart_filtered_restart(const stewart_law *law, real *memory);
void stewart_filtered_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
real stewart_filtered_uncertainty(const stewart_law *law, const real *memory, real *L);
