/* Observers of a plate whose delay is known. What they assume is `sensing` and `estimation` of the law:
   `stewart_state_sensor` or `stewart_encoders`, and `stewart_filter_settings`. */

#ifndef STEWART_OBSERVERS_H
#define STEWART_OBSERVERS_H

#include "filter.h"
#include "law.h"

/* `filter` without machine, sensing and encoders, which are the law's. */
typedef struct {
    stewart_filter filter;
    int encoders;      /* whether the sensing is of encoders */
    const real *prior; /* (p) of the parameters */
} stewart_filter_settings;

extern const stewart_observer stewart_state_observer;       /* the measured state, without a filter */
extern const stewart_observer stewart_differences_observer; /* encoders without a filter */
extern const stewart_observer stewart_filter_observer;
extern const stewart_observer stewart_gap_observer; /* a filter for measurements that get lost */

#endif
