/* Functions that observers of a plate with a known delay share. */

#pragma once

#include "filter_attempt.h"
#include "observers.h"

/* Predict the state (12) a period later with the known parameters; and scratch memory for it. */
void stewart_move_on(const stewart_law *law, int number, const real *torques, real *state,
                     stewart_scratch scratch);
int stewart_moving_scratch(const stewart_law *law);

/* Keep the finite values. */
void stewart_keep_last(int number, const real *values, real *last);

void stewart_known_last_period(const stewart_law *law, const real *memory, int number,
                               const real *torques, stewart_schedule *schedule,
                               const real **following, stewart_scratch *scratch);
void stewart_plain_assume(const stewart_law *law, real *memory, const real *state);

/* Without a filter: the memory is a state and the last measurement. */
int stewart_plain_memory(const stewart_law *law);
void stewart_plain_start(const stewart_law *law, real *memory);
void stewart_plain_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_plain_restart(const stewart_law *law, real *memory);
void stewart_plain_parameters(const stewart_law *law, const real *memory, real *theta, real *std);

/* With a filter: the memory is an estimate, the last measurement, and the number of periods for which
   the code of each leg has been constant. */
int stewart_estimate_numbers(const stewart_law *law);
int stewart_filtered_memory(const stewart_law *law);
int stewart_filtered_scratch(const stewart_law *law);
void stewart_filtered_start(const stewart_law *law, real *memory);
int stewart_filtered_observe(const stewart_law *law, real *memory, int number, const real *torques,
                             const real *values, stewart_scratch scratch);
void stewart_filtered_tell(const stewart_law *law, const real *memory, int number,
                           const real *torques, stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_filtered_restart(const stewart_law *law, real *memory);
void stewart_filtered_parameters(const stewart_law *law, const real *memory, real *theta, real *std);

/* The filter of a law with its sensing. */
stewart_filter stewart_filter_of(const stewart_law *law, const stewart_sensing *sensing);

/* Torques of the last period, for the filter. */
stewart_interval stewart_last_interval(const stewart_law *law, int number, const real *torques,
                                       stewart_scratch *scratch);
