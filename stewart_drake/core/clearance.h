/* Distances that a plan keeps: reach of the legs, and clearance between their links. */

#pragma once

#include "real.h"

/* Compute the room (number, 6 + pairs) at poses (number, 6): the reach that each leg has left, then the
   clearance of pairs of links (pairs, 2), both over `unit` and less `least` (6 + pairs). Links 0 to 5 are cranks,
   6 to 11 rods, of `radii` (12). Lengths are in m. Room is negative for legs out of reach, NaN for their links. */
void stewart_room(const real *geometry, int number, const real *poses, int pairs, const int *links,
                  const real *radii, real unit, const real *least, real *room);
