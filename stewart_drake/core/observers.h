/* Observers of a plate whose delay is known. What they assume is `sensing` and `estimation` of the law:
   `stewart_state_sensor` or `stewart_encoders`, and `stewart_filter_settings`. */

#pragma once

#include "filter.h"
#include "law.h"

/* `filter` without machine, sensing and legs, which are the law's. */
typedef struct {
    stewart_filter filter;
    const real *prior; /* (p) of the parameters */
} stewart_filter_settings;

/* Of the measured state. */
extern const stewart_observer stewart_state_observer; /* without a filter */
extern const stewart_observer stewart_filter_observer;
extern const stewart_observer stewart_gap_observer; /* a filter for measurements that get lost */

/* Of encoders. */
extern const stewart_observer stewart_differences_observer; /* without a filter */
extern const stewart_observer stewart_encoder_observer;
