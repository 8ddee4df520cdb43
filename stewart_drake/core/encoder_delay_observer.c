/* The observer of an unknown delay with encoders. It takes the angles of the last sample of a period. */

#include "delay_observer.h"
#include "encoders.h"

const stewart_observer stewart_encoder_delay_observer = {
    stewart_delayed_memory,  stewart_delayed_scratch, stewart_delayed_start,
    stewart_delayed_observe, stewart_delayed_start,   stewart_delayed_parameters,
    stewart_newest_encoders, stewart_delayed_outlook, stewart_delayed_last_period,
    stewart_delayed_uncertainty,
};
