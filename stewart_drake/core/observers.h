/* Observers of a known delay that take the measured state as it is, without a covariance. Their memory is
   a state and the last measurement. */

#pragma once

#include "law.h"

extern const stewart_observer stewart_state_observer; /* the state as measured */
extern const stewart_observer stewart_timing_observer; /* the same, and it learns the timing of torques */
extern const stewart_observer stewart_differences_observer; /* the pose from encoders, rates by differences */

/* Advance the state (12) by a period with the nominal parameters. */
void stewart_predict_nominal(const stewart_law *law, int number, const real *torques, real *state,
                             stewart_scratch scratch);
int stewart_nominal_scratch(const stewart_law *law);

/* Copy those of `values` that are finite to `last`. */
void stewart_keep_last(int number, const real *values, real *last);

/* Parts of these observers: functions of the same names in `stewart_observer`. */
int stewart_plain_memory(const stewart_law *law);
void stewart_plain_start(const stewart_law *law, real *memory);
void stewart_plain_restart(const stewart_law *law, real *memory);
void stewart_plain_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
