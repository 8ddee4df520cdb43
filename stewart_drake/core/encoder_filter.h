/* The filter for encoders: legs at several instants of a period. */

#pragma once

#include "encoders.h"
#include "filter.h"

#define STEWART_LEG_GATE 30 /* squared residual of a leg, per variance, from which it is left out */

/* `legs` of a filter whose sensing is `stewart_encoder_sensing`. */
extern const stewart_legs stewart_encoder_legs;
