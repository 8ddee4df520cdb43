#include "machine.h"
#include "short.h"

#define FINE_SUBSTEP_FACTOR 2 /* on the substeps above `coarse_torque_limit`, see law/nominal.py */

void stewart_set_model(const stewart_machine *machine, const real *theta, stewart_model *model)
{
    stewart_copy(STEWART_PARAMETERS, machine->parameters, model->parameters);
    for (int i = 0; theta && i < machine->estimated; i++)
        if (machine->place[i] >= 0)
            model->parameters[machine->place[i]] = theta[i];
    model->plant.geometry = machine->geometry;
    model->plant.gravity = &machine->gravity;
    model->plant.joints = machine->joints;
    model->plant.parameters = model->parameters;
    model->acceleration_per_torque = machine->acceleration_per_torque;
}

void stewart_accelerate(const stewart_model *model, const real *state, const real *torque,
                        real *accelerations)
{
    const real *per_torque = model->acceleration_per_torque;
    if (!per_torque) {
        stewart_accelerations(&model->plant, state, state + 6, torque, accelerations);
        return;
    }
    for (int i = 0; i < 6; i++) {
        accelerations[i] = 0;
        for (int j = 0; j < U; j++) /* the biases are the first of the parameters */
            accelerations[i] += per_torque[U * i + j] * (torque[j] + model->parameters[j]);
    }
}

int stewart_substeps(const stewart_machine *machine, int number, const real *torques)
{
    for (int i = 0; i < U * number; i++)
        if (REAL(fabs)(torques[i]) > machine->coarse_torque_limit)
            return FINE_SUBSTEP_FACTOR * machine->substeps;
    return machine->substeps;
}

int stewart_at_limit(const stewart_machine *machine, int number, const real *torques)
{
    if (machine->own)
        return machine->own->at_limit(machine, number, torques);
    for (int i = 0; i < U * number; i++)
        if (REAL(fabs)(torques[i]) >= machine->torque_limit)
            return 1;
    return 0;
}

void stewart_required_torque(const stewart_model *model, const real *row, real *torque)
{
    real per_torque[36];
    if (!model->acceleration_per_torque) {
        stewart_inverse_dynamics(&model->plant, row, row + 6, row + 12, torque);
        return;
    }
    stewart_copy(36, model->acceleration_per_torque, per_torque);
    stewart_copy(U, row + 12, torque);
    if (!stewart_solve(6, 1, per_torque, torque))
        stewart_fill(U, (real)NAN, torque);
    for (int i = 0; i < U; i++)
        torque[i] -= model->parameters[i];
}

void stewart_advance(const stewart_model *model, const real *torque, real duration, int substeps,
                     real *state, real *low)
{
    real a[6];
    if (!model->acceleration_per_torque) {
        for (int i = 0; i < substeps; i++)
            stewart_runge_kutta_step(&model->plant, torque, duration / (real)substeps, state, low);
        return;
    }
    stewart_accelerate(model, state, torque, a);
    for (int i = 0; i < 6; i++) {
        state[i] += duration * (state[6 + i] + duration / 2 * a[i]);
        state[6 + i] += duration * a[i];
    }
}

void stewart_predict(const stewart_machine *machine, const real *theta, const stewart_schedule *schedule,
                     const real *state, real *low, real *states)
{
    real none[X] = {0};
    if (machine->own) {
        machine->own->predict(machine, theta, schedule, state, states);
        return;
    }
    const int substeps = schedule->substeps
                             ? schedule->substeps
                             : stewart_substeps(machine, schedule->number, schedule->torques);
    stewart_model model;
    stewart_set_model(machine, theta, &model);
    for (int k = 0; k < schedule->number; k++, state = states, states += X) {
        stewart_copy(X, state, states);
        stewart_advance(&model, schedule->torques + U * k, schedule->durations[k], substeps, states,
                        low ? low : none);
    }
}

/* right (6, 18 + p) <- -M^-1 dF/d[state, torque, theta] of the equations F of dynamics.h; dF/dtorque = -B.
   dF_dx, dF_dp and M are by columns, B and `mass`, which is M, by rows. */
static int solve_acceleration_derivatives(const stewart_machine *machine, const stewart_model *model,
                                          const real *state, const real *torque, int p, real *right,
                                          stewart_scratch scratch)
{
    const int columns = X + U + p;
    real *dF_dx = stewart_take(&scratch, 6 * X);
    real *dF_dp = stewart_take(&scratch, 6 * STEWART_PARAMETERS);
    real accelerations[6], M[36], mass[36], B[36];
    stewart_accelerations(&model->plant, state, state + 6, torque, accelerations);
    stewart_residual_derivatives(&model->plant, state, state + 6, accelerations, torque, dF_dx,
                                 dF_dp, M, B);
    for (int i = 0; i < 6; i++) {
        real *row = right + columns * i;
        for (int j = 0; j < 6; j++)
            mass[6 * i + j] = M[6 * j + i];
        for (int j = 0; j < X; j++)
            row[j] = -dF_dx[6 * j + i];
        for (int j = 0; j < U; j++)
            row[X + j] = B[6 * i + j];
        for (int j = 0; j < p; j++)
            row[X + U + j] = machine->place[j] < 0 ? 0 : -dF_dp[6 * machine->place[j] + i];
    }
    return stewart_solve(6, columns, mass, right);
}

int stewart_derivatives(const stewart_machine *machine, const stewart_model *model,
                        const real *state, const real *torque, real *A, real *B, real *G,
                        stewart_scratch scratch)
{
    const int p = G ? machine->estimated : 0, columns = X + U + p;
    real *right = stewart_take(&scratch, 6 * columns);
    const real *per_torque = model->acceleration_per_torque;
    if (per_torque) {
        stewart_fill(6 * columns, 0, right);
        for (int i = 0; i < 6; i++) {
            stewart_copy(U, per_torque + U * i, right + columns * i + X);
            for (int j = 0; j < p; j++)
                if (machine->place[j] >= 0 && machine->place[j] < U)
                    right[columns * i + X + U + j] = per_torque[U * i + machine->place[j]];
        }
    } else if (!solve_acceleration_derivatives(machine, model, state, torque, p, right, scratch)) {
        return 0;
    }
    stewart_fill(6 * X, 0, A);
    stewart_fill(6 * U, 0, B);
    if (G)
        stewart_fill(6 * p, 0, G);
    for (int i = 0; i < 6; i++) {
        const real *row = right + columns * i;
        A[X * i + 6 + i] = 1;
        stewart_copy(X, row, A + X * (6 + i));
        stewart_copy(U, row + X, B + U * (6 + i));
        if (G)
            stewart_copy(p, row + X + U, G + p * (6 + i));
    }
    return 1;
}

/* State at s in [0, 1] of h seconds, on the cubic through the states at both ends. */
static void hermite_state(const real *start, const real *end, real h, real s, real *state)
{
    real left = 1 - s;
    for (int i = 0; i < 6; i++) {
        real rise = (end[i] - start[i]) / h; /* mean rate */
        real a = start[6 + i] - rise, b = end[6 + i] - rise;
        state[i] = left * start[i] + s * end[i] + h * s * left * (left * a - s * b);
        state[6 + i] = rise + left * (1 - 3 * s) * a + s * (3 * s - 2) * b;
    }
}

/* Phi (12, 12) and S (12, p) of one torque that leads from `start` to `end` in h seconds, the first rows
   of the solution F of F_dot = L F, L = [A G; 0 0]. With L1 and L2 at the two Gauss nodes, the method of
   fourth order is F = exp(h/2 (L1 + L2) + sqrt(3)/12 h^2 [L2, L1]). Else the midpoint rule,
   F = exp(h L). The exponent is [omega omega_theta; 0 0]. */
static int transition_of_hold(const stewart_machine *machine, const stewart_model *model,
                              const real *torque, real h, int fourth_order, const real *start,
                              const real *end, real *Phi, real *S, stewart_scratch scratch)
{
    const int p = machine->estimated, nodes = 1 + fourth_order;
    real *A = stewart_take(&scratch, nodes * X * X), *G = stewart_take(&scratch, nodes * X * p);
    real *omega = stewart_take(&scratch, X * X), *omega_theta = stewart_take(&scratch, X * p);
    real *B = stewart_take(&scratch, X * U), state[X];
    for (int node = 0; node < nodes; node++) {
        hermite_state(start, end, h, fourth_order ? GAUSS_NODES[node] : (real)0.5, state);
        if (!stewart_derivatives(machine, model, state, torque, A + X * X * node, B,
                                 G + X * p * node, scratch))
            return 0;
    }
    if (fourth_order) {
        const real part = SQRT_3 / 12 * h * h;
        const real *A1 = A, *A2 = A + X * X, *G1 = G, *G2 = G + X * p;
        real *A2A1 = stewart_take(&scratch, X * X), *A1A2 = stewart_take(&scratch, X * X);
        real *A2G1 = stewart_take(&scratch, X * p), *A1G2 = stewart_take(&scratch, X * p);
        stewart_multiply(X, X, X, A2, A1, A2A1);
        stewart_multiply(X, X, X, A1, A2, A1A2);
        stewart_multiply(X, X, p, A2, G1, A2G1);
        stewart_multiply(X, X, p, A1, G2, A1G2);
        for (int i = 0; i < X * X; i++)
            omega[i] = h / 2 * (A1[i] + A2[i]) + part * (A2A1[i] - A1A2[i]);
        for (int i = 0; i < X * p; i++)
            omega_theta[i] = h / 2 * (G1[i] + G2[i]) + part * (A2G1[i] - A1G2[i]);
    } else {
        for (int i = 0; i < X * X; i++)
            omega[i] = h * A[i];
        for (int i = 0; i < X * p; i++)
            omega_theta[i] = h * G[i];
    }
    stewart_exponential(X, p, omega, omega_theta, Phi, S, scratch);
    return 1;
}

int stewart_transitions(const stewart_machine *machine, const real *xi, const stewart_schedule *schedule,
                        int fourth_order, const real *states, int next, real *H, stewart_scratch scratch)
{
    const int p = machine->estimated, n = X + p;
    real *Phi = stewart_take(&scratch, X * X), *S = stewart_take(&scratch, X * p);
    real *before = stewart_take(&scratch, X * n);
    const real *start = xi;
    stewart_model model;
    stewart_set_model(machine, xi + X, &model);
    for (int k = 0; k < schedule->number; k++, start = states, states += X, H += next) {
        const real *torque = schedule->torques + U * k, h = schedule->durations[k];
        if (!transition_of_hold(machine, &model, torque, h, fourth_order, start, states, Phi, S, scratch))
            return 0;
        if (k > 0) /* [Phi S; 0 1] [H; 0 1] */
            stewart_multiply(X, X, n, Phi, before, H);
        else
            for (int i = 0; i < X; i++) {
                stewart_copy(X, Phi + X * i, H + n * i);
                stewart_fill(p, 0, H + n * i + X);
            }
        for (int i = 0; i < X; i++)
            for (int j = 0; j < p; j++)
                H[n * i + X + j] += S[p * i + j];
        stewart_copy(X * n, H, before);
    }
    return 1;
}

int stewart_transitions_scratch(int p)
{
    const int held = X * X + X * p, nodes = 4 * X * X + 4 * X * p;
    const int derivatives = 6 * (X + STEWART_PARAMETERS + X + U + p);
    const int exponential = 4 * X * X + X * (p > X ? p : X);
    return X * (X + p) + 2 * held + nodes + X * U + (derivatives > exponential ? derivatives : exponential);
}
