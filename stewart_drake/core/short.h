/* Short names, for the sources alone. */

#pragma once

#include "real.h"

#define X 12 /* state: pose and rates */
#define U 6  /* torques */
#define ROW 18 /* reference: pose, rates, accelerations */
#define LEGS 6

static const real GAUSS_NODES[2] = {(real)0.21132486540518713, (real)0.7886751345948129};
static const real SQRT_3 = (real)1.7320508075688772;
#define SQRT_HALF ((real)0.70710678118654752)
#define TURN ((real)6.283185307179586) /* rad */

static inline real clamped(real low, real x, real high) { return x < low ? low : x > high ? high : x; }
