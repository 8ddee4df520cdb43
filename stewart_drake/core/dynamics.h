/* The equations of motion of a machine. No state, no allocation: any thread may call. */

#pragma once

#include "real.h"

#define STEWART_PARAMETERS 13 /* of the equations, see scenario/signals.py */
#define STEWART_GEOMETRY 121 /* numbers of a machine, see core/layout.py */
#define STEWART_MEASURES 8   /* of the workspace */

/* A machine and its parameters. */
typedef struct {
    const real *geometry;   /* STEWART_GEOMETRY numbers */
    const real *parameters; /* STEWART_PARAMETERS: torque biases (6, N m), payload (kg), .. */
    const real *gravity;    /* m/s^2, along -z */
} stewart_plant;

/* A pose and its rates are 6 numbers each, angles (rad) before positions (m), torques 6 in N m, a
   state is pose and rates; matrices are stored by columns. */

/* Second derivative of the pose. */
void stewart_accelerations(const stewart_plant *plant, const real *pose, const real *rates,
                           const real *torque, real *accelerations);

/* Torques that give these accelerations. */
void stewart_inverse_dynamics(const stewart_plant *plant, const real *pose, const real *rates,
                              const real *accelerations, real *torque);

/* Slope (12) of a state (12): its rates and accelerations. */
void stewart_change(const stewart_plant *plant, const real *state, const real *torque, real *slope);

/* Kinetic and potential energy, J. */
void stewart_energy(const stewart_plant *plant, const real *pose, const real *rates, real *energy);

/* Mass matrix M (6, 6), bias h (6) and input matrix B' (6, 6) in coordinates of the pose. */
void stewart_terms(const stewart_plant *plant, const real *pose, const real *rates, real *M,
                   real *h, real *B);

/* Of F = M accelerations + h - B torque at constant accelerations: dF/dstate (6, 12),
   dF/dparameters (6, STEWART_PARAMETERS), then M (6, 6), and B (6, 6) by rows. */
void stewart_residual_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                                  const real *accelerations, const real *torque, real *dF_dx,
                                  real *dF_dp, real *M, real *B);

/* Sine of each crank's angle off dead centre (6), the signed measure of parallel singularity, minus
   the pitch's amount; `angles` of the cranks where they are known, else NULL. */
void stewart_measures(const real *geometry, const real *pose, const real *angles, real *measures);

/* Advance a state (12) by one step of h seconds of the classical Runge-Kutta method. */
void stewart_move(const stewart_plant *plant, const real *torque, real h, real *state);
