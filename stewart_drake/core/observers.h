/* Observers without a filter, of a plate with a known delay. Their memory is a state and the last
   measurement. */

#pragma once

#include "law.h"

extern const stewart_observer stewart_state_observer;       /* of the measured state */
extern const stewart_observer stewart_timing_observer;      /* that also learns when torques come */
extern const stewart_observer stewart_differences_observer; /* of encoders */

/* Predict the state (12) a period later with the known parameters; and scratch memory for it. */
void stewart_move_on(const stewart_law *law, int number, const real *torques, real *state,
                     stewart_scratch scratch);
int stewart_moving_scratch(const stewart_law *law);

/* Keep the finite values. */
void stewart_keep_last(int number, const real *values, real *last);

int stewart_plain_memory(const stewart_law *law);
void stewart_plain_start(const stewart_law *law, real *memory);
void stewart_plain_restart(const stewart_law *law, real *memory);
void stewart_plain_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
