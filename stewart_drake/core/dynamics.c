/* See dynamics.h. The long expressions are generated, in equations.h. */

#include <string.h>

#include "dynamics.h"

#include "equations.h"
#include "short.h"

#if PARAMETERS != STEWART_PARAMETERS || GEOMETRY != STEWART_GEOMETRY
#error "dynamics.h and equations.h are of different equations"
#endif

#define SUMS 28 /* numbers of `equations.Sums`, symmetric matrices as triangles */
#define BIAS_FORCE 21 /* place of h (6) among them */
#define DAMPING 7 /* place of the cranks' viscous friction among the parameters */
#define BALL_JOINTS 13 /* place of the ball joints' three parameters */
#define COMMON (LEGS * LEG_NUMBERS) /* place of the numbers after those of the legs */

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
    *energy = m.sums[SUMS - 1];
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

/* The part (6) of each leg in F, from the sums, arms and rates of `leg_motion`. */
static void forces_of_legs(const real *parameters, const real *nu_dot, const real *torque, const real *sums,
                           const real *arms, const real *rates, real force[LEGS][6])
{
    static const int entry[6][6] = {{0, 1, 3, 6, 9, 12},     {1, 2, 4, 7, 10, 13},
                                    {3, 4, 5, 8, 11, 14},    {6, 7, 8, 15, 16, 18},
                                    {9, 10, 11, 16, 17, 19}, {12, 13, 14, 18, 19, 20}};
    real slip[LEGS];
    slips(rates, parameters, slip);
    for (int leg = 0; leg < LEGS; leg++) {
        const real resisted = parameters[DAMPING] * rates[leg] + parameters[COULOMB] * slip[leg];
        const real at_shaft = torque[leg] + parameters[leg] - resisted;
        for (int i = 0; i < 6; i++) {
            force[leg][i] = sums[LEGS * (BIAS_FORCE + i) + leg] - arms[LEGS * i + leg] * at_shaft;
            for (int j = 0; j < 6; j++)
                force[leg][i] += sums[LEGS * entry[i][j] + leg] * nu_dot[j];
        }
    }
}

/* A leg's numbers change its own part only, so that one difference serves all six. */
void stewart_leg_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                             const real *accelerations, const real *torque, real *dF_dlegs)
{
    static const int places[8] = {0, 1, 12, 13, 14, 15, 16, 17};
    const real *common = plant->geometry + COMMON, *p = plant->parameters;
    const real st = REAL(sin)(pose[1]), ct = REAL(cos)(pose[1]), h = (real)1e-5 * plant->geometry[0];
    const real sp = REAL(sin)(pose[2]), cp = REAL(cos)(pose[2]), *a = accelerations, *r = rates;
    /* nu_dot = [E a + E_dot r; a] */
    const real nu_dot[6] = {
        cp * ct * a[0] - sp * a[1] - (sp * ct * r[2] + cp * st * r[1]) * r[0] - cp * r[2] * r[1],
        sp * ct * a[0] + cp * a[1] + (cp * ct * r[2] - sp * st * r[1]) * r[0] - sp * r[2] * r[1],
        a[2] - st * a[0] - ct * r[1] * r[0],
        a[3],
        a[4],
        a[5],
    };
    real moving[21], alone[SUMS], legs[COMMON], force[2][LEGS][6];
    plate_motion(pose, rates, p, plant->gravity, common, moving, alone);
    memcpy(legs, plant->geometry, sizeof legs);
    for (int k = 0; k < 8; k++) {
        for (int side = 0; side < 2; side++) {
            real sums[SUMS * LEGS], arms[36], crank_rates[LEGS];
            for (int i = LEGS * places[k]; i < LEGS * (places[k] + 1); i++)
                legs[i] = plant->geometry[i] + (side ? h : -h);
            leg_motion(moving, common, legs, sums, arms, crank_rates);
            forces_of_legs(p, nu_dot, torque, sums, arms, crank_rates, force[side]);
        }
        memcpy(legs, plant->geometry, sizeof legs);
        for (int leg = 0; leg < LEGS; leg++)
            for (int i = 0; i < 6; i++)
                dF_dlegs[6 * (8 * leg + k) + i] = (force[1][leg][i] - force[0][leg][i]) / (2 * h);
    }
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

void stewart_move(const stewart_plant *plant, const real *torque, real h, real *x)
{
    static const real part[3] = {(real)0.5, (real)0.5, 1};
    real y[12], k[4][12];
    memcpy(y, x, sizeof y);
    for (int stage = 0; stage < 4; stage++) {
        stewart_change(plant, y, torque, k[stage]);
        if (stage < 3)
            for (int i = 0; i < 12; i++)
                y[i] = x[i] + part[stage] * h * k[stage][i];
    }
    for (int i = 0; i < 12; i++)
        x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
}
