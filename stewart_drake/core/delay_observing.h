/* The functions of observers of an unknown delay. */

#pragma once

#include "delay_observer.h"

int stewart_delayed_memory(const stewart_law *law);
int stewart_delayed_scratch(const stewart_law *law);
void stewart_delayed_start(const stewart_law *law, real *memory);
int stewart_delayed_observe(const stewart_law *law, real *memory, int number, const real *torques,
                            const real *values, stewart_scratch scratch);
void stewart_delayed_tell(const stewart_law *law, const real *memory, int number,
                          const real *torques, stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_delayed_assume(const stewart_law *law, real *memory, const real *state);
void stewart_delayed_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
void stewart_delayed_last_period(const stewart_law *law, const real *memory, int number,
                                 const real *torques, stewart_schedule *schedule,
                                 const real **following, stewart_scratch *scratch);
