/* Observers of an unknown delay. `sensing` of the law is `stewart_state_sensor` or
   `stewart_encoders`, `estimation` is `stewart_delay_settings`. */

#pragma once

#include "delay.h"
#include "law.h"

/* `delay` without machine and sensing, which are the law's, as in `stewart_filter_settings`. */
typedef struct {
    stewart_delay delay;
    int values; /* of one sample */
    int most;   /* torques that act until the next one does, at the most */
} stewart_delay_settings;

extern const stewart_observer stewart_delay_observer;
