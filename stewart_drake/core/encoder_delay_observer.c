/* The observer of an unknown delay with encoders, of which the angles of a sample alone count. */

#include "delay_observing.h"
#include "encoders.h"

#define LEGS 6

static stewart_encoders newest_of(const stewart_law *law)
{
    stewart_encoders newest = *(const stewart_encoders *)law->sensing;
    newest.samples = newest.nodes = 1;
    return newest;
}

static void start(const stewart_law *law, real *memory)
{
    const stewart_encoders newest = newest_of(law);
    const stewart_sensing sensing = stewart_encoder_sensing(&newest);
    stewart_delayed_start(law, &sensing, memory);
}

static int observe(const stewart_law *law, real *memory, int number, const real *torques,
                   const real *values, stewart_scratch scratch)
{
    const stewart_encoders newest = newest_of(law);
    const stewart_sensing sensing = stewart_encoder_sensing(&newest);
    const real *now = values + law->measured - LEGS;
    return stewart_delayed_observe(law, &sensing, stewart_encoder_fault(&newest, now), memory, number,
                                   torques, now, scratch);
}

const stewart_observer stewart_encoder_delay_observer = {
    stewart_delayed_memory, stewart_delayed_scratch,    start,
    observe,                stewart_delayed_tell,       stewart_delayed_assume,
    start,                  stewart_delayed_parameters, stewart_delayed_last_period,
    0,
};
