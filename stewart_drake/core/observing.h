/* What observers of a plate whose delay is known share: functions of their tables, and the rest. */

#ifndef STEWART_OBSERVING_H
#define STEWART_OBSERVING_H

#include "observers.h"

/* A cause of `stewart_sensing` is so many bits further to the left in a status. */
#define STEWART_CAUSES_AT 3

/* The state (12) a period later by what is known beforehand, and the scratch memory that takes. */
void stewart_move_on(const stewart_law *law, int number, const real *torques, real *state,
                     stewart_scratch scratch);
int stewart_moving_scratch(const stewart_law *law);

/* The last value of each measured quantity that was there. */
void stewart_keep_last(const stewart_law *law, const real *values, real *last);

void stewart_known_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
void stewart_known_last_period(const stewart_law *law, const real *memory, int number,
                               const real *torques, stewart_schedule *schedule, const real **following,
                               stewart_scratch *scratch);

/* Without a filter: the memory is a state and the last measurement. */
int stewart_plain_memory(const stewart_law *law);
void stewart_plain_start(const stewart_law *law, real *memory);
void stewart_plain_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_plain_assume(const stewart_law *law, real *memory, const real *state);
void stewart_plain_restart(const stewart_law *law, real *memory);

/* With a filter: an estimate, the last measurement, periods of each leg without a change of code. */
int stewart_estimate_numbers(const stewart_law *law);
int stewart_filtered_memory(const stewart_law *law);
void stewart_filtered_start(const stewart_law *law, real *memory);
void stewart_filtered_restart(const stewart_law *law, real *memory);
void stewart_filtered_tell(const stewart_law *law, const real *memory, int number,
                           const real *torques, stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_filtered_parameters(const stewart_law *law, const real *memory, real *theta,
                                 real *std);

/* The filter of a law with its sensing; `legs` as of `stewart_filter`. */
stewart_filter stewart_filter_of(const stewart_law *law, const stewart_sensing *sensing,
                                 const stewart_legs *legs);

/* What acted in the last period, for the filter. */
stewart_interval stewart_last_interval(const stewart_law *law, int number, const real *torques,
                                 stewart_scratch *scratch);

/* `observe` with such a filter, of a measurement with this fault or 0, and the scratch memory. */
int stewart_filtered_observe(const stewart_law *law, const stewart_sensing *sensing,
                             const stewart_legs *legs, int fault, real *memory, int number,
                             const real *torques, const real *values, stewart_scratch scratch);
int stewart_filtered_scratch(const stewart_law *law, const stewart_sensing *sensing,
                             const stewart_legs *legs);

/* The filter for a measured state. */
int stewart_state_filter_observe(const stewart_law *law, real *memory, int number,
                                 const real *torques, const real *values, stewart_scratch scratch);
int stewart_state_filter_scratch(const stewart_law *law);

#endif
