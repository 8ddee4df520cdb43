/* The observer of an unknown delay with encoders. It takes the angles of the last sample of a period. */

#include "delay_observing.h"
#include "encoders.h"

const stewart_observer stewart_encoder_delay_observer = {
    stewart_delayed_memory,  stewart_delayed_scratch,    stewart_delayed_start,
    stewart_delayed_observe, stewart_delayed_tell,       stewart_delayed_assume,
    stewart_delayed_start,   stewart_delayed_parameters, stewart_delayed_last_period,
    0,                       stewart_newest_encoders,
};
