/* The equations of motion of a machine. No state, no allocation: any thread may call. */

#pragma once

#include "real.h"

#define STEWART_PARAMETERS 22 /* of the equations, see scenario/signals.py */
#define STEWART_GEOMETRY 133 /* numbers of a machine, see core/layout.py */
#define STEWART_NUM_MEASURES 8   /* of the workspace */

typedef struct stewart_joint_friction stewart_joint_friction;

/* A machine and its parameters. */
typedef struct {
    const real *geometry;   /* STEWART_GEOMETRY numbers */
    const real *parameters; /* STEWART_PARAMETERS: torque biases (6, N m), payload (kg), .. , wrench (6) */
    const real *gravity;    /* m/s^2, along -z */
    const stewart_joint_friction *joints; /* NULL: none */
} stewart_plant;

/* Friction of passive joints: a force on the plate in the coordinates of its pose. */
struct stewart_joint_friction {
    /* F (6) at a pose and its rates, added to h. Beyond the workspace it stays finite. */
    void (*force)(const stewart_plant *plant, const real *pose, const real *rates, real *force);
    /* Add dF/d[pose; rates] (6, 12) to `by_state`, and compute dF/d[c, f, s] (6, 3) of ball_joints.h in
       `by_parameters`, both by columns and by central differences. */
    void (*derivatives)(const stewart_plant *plant, const real *pose, const real *rates, real *by_state,
                        real *by_parameters);
};

/* A pose and its rates are 6 numbers each, angles (rad) before positions (m); a torque is 6 in N m; a state is
   pose and rates. Matrices of this header are stored by columns. */

/* Second derivative of the pose. */
void stewart_accelerations(const stewart_plant *plant, const real *pose, const real *rates,
                           const real *torque, real *accelerations);

/* Torques that give these accelerations. */
void stewart_inverse_dynamics(const stewart_plant *plant, const real *pose, const real *rates,
                              const real *accelerations, real *torque);

/* Time derivative (12) of a state (12): its rates and accelerations. */
void stewart_change(const stewart_plant *plant, const real *state, const real *torque, real *slope);

/* Kinetic and potential energy, J. */
void stewart_energy(const stewart_plant *plant, const real *pose, const real *rates, real *energy);

/* Derivatives of F = M accelerations + h - B torque at constant accelerations: dF/dstate (6, 12),
   dF/dparameters (6, STEWART_PARAMETERS), then M (6, 6), and B (6, 6) by rows. Without friction of the
   ball joints, derivatives by its parameters are 0. */
void stewart_residual_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                                  const real *accelerations, const real *torque, real *dF_dx,
                                  real *dF_dp, real *M, real *B);

/* Measures of the workspace (8): sine of each crank's angle off dead centre (6), the signed measure of
   parallel singularity, and -|pitch|. `angles` are those of the cranks if known, else NULL. */
void stewart_measures(const real *geometry, const real *pose, const real *angles, real *measures);

/* Advance a state (12) by one step of h seconds of the classical Runge-Kutta method; `low` as of
   `stewart_accumulate`. */
void stewart_runge_kutta_step(const stewart_plant *plant, const real *torque, real h, real *state, real *low);
