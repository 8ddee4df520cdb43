/* What observers of an unknown delay share: functions of their tables, and `observe`. */

#ifndef STEWART_DELAY_OBSERVING_H
#define STEWART_DELAY_OBSERVING_H

#include "delay_observer.h"

int stewart_delayed_memory(const stewart_law *law);
int stewart_delayed_scratch(const stewart_law *law);

/* `start` with the sensing of a sample alone. */
void stewart_delayed_start(const stewart_law *law, const stewart_sensing *sensing, real *memory);

/* The last measurement, of the sample alone. */
real *stewart_delayed_last(const stewart_law *law, real *memory);

/* `observe` of values of a sample alone, with this fault or 0. */
int stewart_delayed_observe(const stewart_law *law, const stewart_sensing *sensing, int fault,
                            real *memory, int number, const real *torques, const real *values,
                            stewart_scratch scratch);

void stewart_delayed_tell(const stewart_law *law, const real *memory, int number,
                          const real *torques, stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_delayed_assume(const stewart_law *law, real *memory, const real *state);
void stewart_delayed_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
void stewart_delayed_last_period(const stewart_law *law, const real *memory, int number,
                                 const real *torques, stewart_schedule *schedule,
                                 const real **following, stewart_scratch *scratch);

#endif
