/* See position_servo.h. */

#include "position_servo.h"
#include "legs.h"

void stewart_position_torque(const stewart_position_servo *servo, const real *geometry,
                             const real *setpoint, const real *state, real *asked, real *torque)
{
    const real *rates = state + 6, limit = servo->torque_limit;
    const Turn turn = turn_of(state);
    /* Angular velocity of the plate. */
    const real w[3] = {dot(turn.E[0], rates), dot(turn.E[1], rates), dot(turn.E[2], rates)};
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        const LegMotion motion = leg_motion_of(&leg, &turn, state, w, rates + 3);
        /* `remainder` is within half a turn: whole turns do not count. */
        const real error = REAL(remainder)(setpoint[i] - motion.angle, TURN);
        asked[i] = servo->stiffness * error - servo->velocity_gain * motion.rate;
        torque[i] = REAL(fmax)(-limit, REAL(fmin)(limit, asked[i]));
    }
}
