/* Observers with a filter, of a plate with a known delay. Their memory is an estimate, the last
   measurement, and the number of periods for which the code of each leg has been constant. */

#pragma once

#include "filter.h"
#include "observers.h"

#define STEWART_LEG_GATE 30 /* squared residual of a leg, per variance, from which it is left out */

/* `estimation` of the law; `filter` without machine, sensing and legs, which are the law's. */
typedef struct {
    stewart_filter filter;
    const real *prior; /* (p) of the parameters */
} stewart_filter_settings;

extern const stewart_observer stewart_filter_observer; /* of the measured state */
extern const stewart_observer stewart_gap_observer;    /* of that, for measurements that get lost */
extern const stewart_observer stewart_encoder_observer;

extern const stewart_legs stewart_encoder_legs;

int stewart_filtered_memory(const stewart_law *law);
int stewart_filtered_scratch(const stewart_law *law);
void stewart_filtered_start(const stewart_law *law, real *memory);
int stewart_filtered_observe(const stewart_law *law, real *memory, int number, const real *torques,
                             const real *values, stewart_scratch scratch);
void stewart_filtered_restart(const stewart_law *law, real *memory);
void stewart_filtered_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
