/* Friction of the ball joints between cranks, rods and plate, by virtual work. Its parameters are the damping
   c (N m s/rad), the friction torque f (N m) and the speed s (rad/s) at which friction changes sides. */

#pragma once

#include "dynamics.h"

/* Let w_1 be the angular velocity of a rod against its crank, w_2 that of the plate against the rod. A
   joint resists with the torque

       tau(w) = (c + f tanh(|w| / s) / |w|) w,     the slope of c |w|^2 / 2 + f s log cosh(|w| / s).

   The rod spins about its axis so that the sum of these potentials of its two joints is least. If only one of
   them has friction, the spin in that joint is 0. Virtual work,

       F' [delta w; delta v] = sum tau_1' delta w_1 + tau_2' delta w_2,

   gives F (6), the moment and force at the plate's COM that resist its motion. F is added to h of the
   equations of motion. */

extern const stewart_joint_friction stewart_ball_joints;
