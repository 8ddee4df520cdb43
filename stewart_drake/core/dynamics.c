/* See dynamics.h. The long expressions are generated, in equations.h. */

#include <string.h>

#include "dynamics.h"
#include "matrix.h"

#include "equations.h"
#include "short.h"

#if PARAMETERS != STEWART_PARAMETERS || GEOMETRY != STEWART_GEOMETRY
#error "dynamics.h and equations.h are of different equations"
#endif

/* `equations.slip` of six cranks. */
static void slips(const real *crank_rates, const real *parameters, real *slip)
{
    for (int leg = 0; leg < LEGS; leg++)
        slip[leg] = REAL(tanh)(crank_rates[leg] / parameters[COULOMB_SPEED]);
}

/* Plate and legs, summed, B' by columns, rates and slips of the cranks. */
typedef struct {
    real sums[SUMS], arms[36], rates[LEGS], slip[LEGS];
} Motion;

static int joints_resist(const stewart_plant *plant)
{
    const real *damping = plant->parameters + BALL_JOINTS, *friction = damping + 1;
    return plant->joints && (*damping != 0 || *friction != 0);
}

static void motion(const stewart_plant *plant, const real *pose, const real *rates, Motion *m)
{
    const real *legs = plant->geometry, *common = legs + COMMON, *parameters = plant->parameters;
    real moving[21], added[SUMS * LEGS];
    plate_motion(pose, rates, parameters, plant->gravity, common, moving, m->sums);
    leg_motion(moving, common, legs, added, m->arms, m->rates);
    for (int i = 0; i < SUMS; i++)
        for (int leg = 0; leg < LEGS; leg++)
            m->sums[i] += added[LEGS * i + leg];
    if (joints_resist(plant)) {
        real force[6];
        plant->joints->force(plant, pose, rates, force);
        for (int i = 0; i < 6; i++)
            m->sums[BIAS_FORCE + i] += force[i];
    }
    /* A tenth of the time, and only needed with Coulomb friction. */
    memset(m->slip, 0, sizeof m->slip);
    if (parameters[COULOMB] != 0)
        slips(m->rates, parameters, m->slip);
}

void stewart_accelerations(const stewart_plant *plant, const real *pose, const real *rates,
                           const real *torque, real *accelerations)
{
    Motion m;
    motion(plant, pose, rates, &m);
    solve_accelerations(pose, rates, torque, plant->parameters, m.rates, m.slip, m.sums, m.arms,
                        accelerations);
}

void stewart_inverse_dynamics(const stewart_plant *plant, const real *pose, const real *rates,
                              const real *accelerations, real *torque)
{
    Motion m;
    motion(plant, pose, rates, &m);
    solve_torque(pose, rates, accelerations, plant->parameters, m.rates, m.slip, m.sums, m.arms,
                 torque);
}

void stewart_change(const stewart_plant *plant, const real *state, const real *torque, real *slope)
{
    memcpy(slope, state + 6, 6 * sizeof(real));
    stewart_accelerations(plant, state, state + 6, torque, slope + 6);
}

void stewart_energy(const stewart_plant *plant, const real *pose, const real *rates, real *energy)
{
    Motion m;
    motion(plant, pose, rates, &m);
    *energy = m.sums[SUMS - 1]; /* the last of `equations.Sums` */
}

void stewart_residual_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                                  const real *accelerations, const real *torque, real *dF_dx,
                                  real *dF_dp, real *M, real *B)
{
    const real *legs = plant->geometry, *common = legs + COMMON;
    const real *parameters = plant->parameters, *gravity = plant->gravity;
    real mass[36], arm_rates[LEGS], slip[LEGS];
    real change_of_legs[72 * LEGS], mass_of_legs[36 * LEGS];
    plate_derivatives(pose, rates, accelerations, parameters, gravity, common, dF_dx, mass);
    crank_rates(pose, rates, legs, arm_rates);
    slips(arm_rates, parameters, slip);
    /* The first six parameters are the biases of the torques. */
    leg_derivatives(pose, rates, accelerations, parameters, gravity, common, legs, torque, parameters,
                    slip, change_of_legs, mass_of_legs, B);
    for (int i = 0; i < 72; i++)
        for (int leg = 0; leg < LEGS; leg++)
            dF_dx[i] += change_of_legs[LEGS * i + leg];
    for (int i = 0; i < 36; i++)
        for (int leg = 0; leg < LEGS; leg++)
            mass[i] += mass_of_legs[LEGS * i + leg];
    pose_derivatives(pose, rates, accelerations, parameters, gravity, mass, B, arm_rates, slip, dF_dp,
                     M);
    if (joints_resist(plant))
        plant->joints->derivatives(plant, pose, rates, dF_dx, dF_dp + 6 * BALL_JOINTS);
}

void stewart_measures(const real *geometry, const real *pose, const real *angles, real *measures)
{
    real sines[LEGS], wrenches[36];
    if (angles)
        leg_measures_of_tree(pose, geometry + COMMON, geometry, angles, sines, wrenches);
    else
        leg_measures(pose, geometry + COMMON, geometry, sines, wrenches);
    all_measures(pose, sines, wrenches, measures);
}

void stewart_runge_kutta_step(const stewart_plant *plant, const real *torque, real h, real *x, real *low)
{
    static const real part[3] = {(real)0.5, (real)0.5, 1};
    real y[12], k[4][12];
    memcpy(y, x, sizeof y);
    for (int stage = 0; stage < 4; stage++) {
        stewart_change(plant, y, torque, k[stage]);
        if (stage < 3)
            for (int i = 0; i < 12; i++)
                y[i] = x[i] + (low[i] + part[stage] * h * k[stage][i]);
    }
    for (int i = 0; i < 12; i++)
        y[i] = h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    stewart_accumulate(12, y, x, low);
}
