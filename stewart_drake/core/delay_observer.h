/* Observers of an unknown delay. `sensing` of the law is `stewart_state_sensor` or
   `stewart_encoders`, `estimation` is `stewart_delay_settings`. */

#pragma once

#include "delay.h"
#include "law.h"

/* `delay` without machine and sensing, which are the law's. */
typedef struct {
    stewart_delay delay;
    int values; /* of one sample */
    int most;   /* torques that act until the next one does, at the most */
} stewart_delay_settings;

extern const stewart_observer stewart_delay_observer; /* of the measured state */
extern const stewart_observer stewart_encoder_delay_observer;

int stewart_delayed_memory(const stewart_law *law);
int stewart_delayed_scratch(const stewart_law *law);
void stewart_delayed_start(const stewart_law *law, real *memory);
int stewart_delayed_observe(const stewart_law *law, real *memory, int number, const real *torques,
                            const real *values, stewart_scratch scratch);
void stewart_delayed_parameters(const stewart_law *law, const real *memory, real *theta, real *std);
real stewart_delayed_uncertainty(const stewart_law *law, const real *memory, real *L);
void stewart_delayed_outlook(const stewart_law *law, const real *memory, int number,
                             const real *torques, stewart_outlook *outlook, stewart_scratch *scratch);
void stewart_delayed_last_period(const stewart_law *law, const real *memory, int number,
                                 const real *torques, stewart_schedule *schedule,
                                 const real **following, stewart_scratch *scratch);
