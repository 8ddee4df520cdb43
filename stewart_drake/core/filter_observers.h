/* Observers with a filter, for a known delay. Their memory is an estimate, the last measurement, and the
   number of periods for which the code of each leg has been constant. */

#pragma once

#include "filter.h"
#include "observers.h"

/* Largest e^2 / S of a leg at a node that is used. Noise exceeds it with probability 4.3e-8, so that one of the
   18 values of three nodes does with 8e-7. It is for one value; `gate` of filter.h is for all m at once. */
#define STEWART_LEG_GATE 30

/* Settings at `law->estimation`. In `filter`, leave machine, sensing and encoder_step unset: the observer fills
   them in from the law. */
typedef struct {
    stewart_filter filter;
    const real *prior; /* (p) initial estimate of the parameters */
} stewart_filter_settings;

extern const stewart_observer stewart_filter_observer; /* of the measured state, or of encoders */
extern const stewart_observer stewart_gap_observer;    /* of the state, re-linearised over gaps */

extern const stewart_encoder_step stewart_encoder_filter_step; /* filter step with encoders, see filter_attempt.h */
stewart_sensing stewart_encoder_filter_sensing(const void *sensor); /* with that step; `stewart_encoders` */
