/* Observers without a filter, of a plate with a known delay. Their memory is a state, the last
   measurement, and the learnt timing of torques, if there is one. */

#pragma once

#include "law.h"

extern const stewart_observer stewart_state_observer;       /* of the measured state */
extern const stewart_observer stewart_differences_observer; /* of encoders */
extern const stewart_observer stewart_timing_observer; /* of the measured state, with the settings below */

typedef struct {
    real model_std[STEWART_STATES]; /* by which one step of the model may be off */
    real timing_std;                /* s by which a torque may come early or late, at first */
    real keep;                      /* share of what is known of the noise that is kept in a period */
} stewart_timing_settings;

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
