/* Position servos by stiffness: the torque at each crank is

       clip(k (u - alpha) - k_v alpha_dot, limit),

   u the setpoint, alpha the crank's angle; whole turns do not count. Damping, Coulomb friction and
   armature of a servo are the plant's, see dynamics.h. */

#pragma once

#include "real.h"

typedef struct {
    real stiffness;     /* k, N m/rad */
    real velocity_gain; /* k_v, N m s/rad */
    real torque_limit;  /* N m, infinite for none */
} stewart_position_servo;

/* Torques (6) of six servos at a state (12), for setpoints (6), and those without limit in `asked` (6).
   Beyond the workspace they stay finite. */
void stewart_position_torque(const stewart_position_servo *servo, const real *geometry,
                             const real *setpoint, const real *state, real *asked, real *torque);
