#include "design.h"
#include "kinematics.h"
#include "observer.h"
#include "short.h"

int stewart_order(const stewart_cost *cost, int pending)
{
    return X + 6 * (cost->integrates != 0) + U * pending;
}

/* Let T(t) be the torque of the motion, T' its slope and s_k = T' dt its change over hold k. Held at its mean
   it gives the rates of the motion at the end of the hold, but puts the pose ahead by

       int_0^dt (dt - t) B (mean - T(t)) dt = B s_k dt^2 / 12,

   which adds up. One torque per period cannot meet both. The poses at the samples are right with

       T_k = mean_k - (s_{k+1} - s_{k-1}) / 24                                              (hold)

   and the rates there differ by -dt/24 B (s_{k-1} + s_k), which feedback must not correct. Torques that
   do not move the plate along the reference have no such difference: s = 0. */
void stewart_hold_feedforward(const stewart_machine *machine, const stewart_cost *cost, const real *theta,
                              int pending, const real *nodes, stewart_feedforward *held)
{
    const int holds = 3 + pending, moves = cost->feedforward == STEWART_INVERSE_DYNAMICS;
    real mean[4][U], at[2][U] = {{0}};
    stewart_model model;
    stewart_set_model(machine, theta, &model);
    for (int k = 0; k < holds; k++) {
        for (int node = 0; node < 2 && cost->feedforward != STEWART_NO_FEEDFORWARD; node++) {
            real row[ROW] = {0};
            stewart_copy(moves ? ROW : 6, nodes + ROW * (2 * k + node), row);
            stewart_required_torque(&model, row, at[node]);
        }
        for (int i = 0; i < U; i++) {
            mean[k][i] = (at[0][i] + at[1][i]) / 2;
            held->change[k][i] = moves ? SQRT_3 * (at[1][i] - at[0][i]) : 0;
        }
    }
    for (int k = 1; k < holds - 1; k++)
        for (int i = 0; i < U; i++) {
            held->torque[k - 1][i] = mean[k][i];
            if (moves)
                held->torque[k - 1][i] -= (held->change[k + 1][i] - held->change[k - 1][i]) / 24;
        }
}

/* The offset of the rates is -dt B s / 12 at the beginning of a hold. After the part x of it the offset is
   -dt B s (1/12 - x (1 - x) / 2) of the rates, and -dt^2 B s x (1 - x) (1 - 2 x) / 12 of the pose. */
void stewart_subtract_offset(real period, real fraction, const real *changes, const real *B,
                             real *error)
{
    const real passed = 1 - fraction, left = passed * (1 - passed);
    for (int i = 0; i < 6; i++) {
        real push = 0;
        for (int j = 0; j < U; j++) {
            real change = changes[U + j] + (fraction > 0 ? 0 : changes[j]);
            push -= period * B[U * i + j] * change;
        }
        if (fraction > 0) {
            error[i] -= period * left * (1 - 2 * passed) / 12 * push;
            error[6 + i] -= ((real)1 / 12 - left / 2) * push;
        } else {
            error[6 + i] -= push / 24;
        }
    }
}

/* Sampled model A (n, n), B (n, 6) of error, integral and pending torque, and the diagonal Q (n, n) and
   R (6, 6). */
typedef struct {
    int n;
    real *A, *B, *Q, *R;
} SampledModel;

/* e+ = Phi e + S_old T_old + S_new T,  z+ = z + dt/2 (e + e+), with the pending torque T_old. */
static void sample(const stewart_cost *cost, real period, real fraction, const real *weights,
                   const real *A, const real *B, SampledModel *m, stewart_scratch scratch)
{
    const int pending = fraction > 0, n = m->n, first = X + 6 * (cost->integrates != 0);
    const real half = period / 2;
    real *Phi[2], *S[2], *A_h = stewart_take(&scratch, X * X);
    real *B_h = stewart_take(&scratch, X * U), *product = stewart_take(&scratch, X * X);
    for (int part = 0; part < 2; part++) { /* after the torque changes, before it */
        Phi[part] = stewart_take(&scratch, X * X);
        S[part] = stewart_take(&scratch, X * U);
    }
    for (int part = 0; part < 1 + pending; part++) {
        const real h = (part == 0 ? 1 - fraction : fraction) * period;
        for (int i = 0; i < X * X; i++)
            A_h[i] = h * A[i];
        for (int i = 0; i < X * U; i++)
            B_h[i] = h * B[i];
        stewart_exponential(X, U, A_h, B_h, Phi[part], S[part], scratch);
    }
    if (pending) {
        stewart_multiply(X, X, U, Phi[0], S[1], product);
        stewart_copy(X * U, product, S[1]);
        stewart_multiply(X, X, X, Phi[0], Phi[1], product);
        stewart_copy(X * X, product, Phi[0]);
    }
    stewart_fill(n * n, 0, m->A);
    stewart_fill(n * U, 0, m->B);
    stewart_fill(n * n, 0, m->Q);
    stewart_fill(U * U, 0, m->R);
    for (int i = 0; i < X; i++) {
        stewart_copy(X, Phi[0] + X * i, m->A + n * i);
        stewart_copy(U, S[0] + U * i, m->B + U * i);
        if (pending)
            stewart_copy(U, S[1] + U * i, m->A + n * i + first);
    }
    for (int i = 0; i < 6; i++) {
        if (cost->integrates) {
            real *row = m->A + n * (X + i);
            for (int j = 0; j < X; j++)
                row[j] = half * ((real)(i == j) + Phi[0][X * i + j]);
            row[X + i] = 1;
            for (int j = 0; j < U; j++) {
                m->B[U * (X + i) + j] = half * S[0][U * i + j];
                if (pending)
                    row[first + j] = half * S[1][U * i + j];
            }
            m->Q[(n + 1) * (X + i)] = weights[0] * cost->integrals[i];
        }
        if (pending)
            m->B[U * (first + i) + i] = 1;
        m->Q[(n + 1) * i] = weights[0] * cost->errors[i];
        m->R[(U + 1) * i] = weights[1] * cost->torques[i];
    }
}

/* Compute the gain (6, n). States and torques are scaled so that each has unit cost (of a state: now and
   at the next sample together). Then no choice of units makes a matrix look singular. */
static int solve_gain(SampledModel *m, int pending, real *K, stewart_scratch scratch)
{
    const int n = m->n;
    real x[STEWART_MAX_ORDER], u[U], *A = m->A, *B = m->B, *Q = m->Q, *R = m->R;
    for (int i = 0; i < U; i++) {
        if (!(R[(U + 1) * i] > 0 && isfinite(R[(U + 1) * i])))
            return 0;
        u[i] = 1 / REAL(sqrt)(R[(U + 1) * i]);
    }
    for (int i = 0; i < n; i++) {
        real cost = Q[(n + 1) * i];
        if (!(cost >= 0))
            return 0;
        for (int j = 0; j < n; j++)
            cost += A[n * j + i] * Q[(n + 1) * j] * A[n * j + i];
        x[i] = cost > 0 && isfinite(cost) ? 1 / REAL(sqrt)(cost) : 1;
    }
    if (pending)
        stewart_copy(U, u, x + n - U);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++)
            A[n * i + j] *= x[j] / x[i];
        for (int j = 0; j < U; j++)
            B[U * i + j] *= u[j] / x[i];
        Q[(n + 1) * i] *= x[i] * x[i];
    }
    for (int i = 0; i < U; i++)
        R[(U + 1) * i] *= u[i] * u[i];
    if (!stewart_all_finite(n * n, A) || !stewart_all_finite(n * U, B) ||
        !stewart_all_finite(n * n, Q))
        return 0;
    if (!stewart_lqr(n, A, B, Q, R, K, NULL, scratch) || !stewart_all_finite(U * n, K))
        return 0;
    for (int i = 0; i < U; i++)
        for (int j = 0; j < n; j++)
            K[n * i + j] *= u[i] / x[j];
    return 1;
}

int stewart_linearize_scratch(void) { return 6 * (X + STEWART_PARAMETERS + X + U); }

int stewart_linearize(const stewart_machine *machine, const real *theta, real period, real fraction,
                      const real *state, const stewart_feedforward *held, real *A, real *B, real *error,
                      stewart_scratch scratch)
{
    stewart_model model;
    if (!machine->acceleration_per_torque && !stewart_is_workable(machine->geometry, state))
        return STEWART_UNREACHABLE;
    stewart_set_model(machine, theta, &model);
    if (!stewart_derivatives(machine, &model, state, held->torque[fraction > 0], A, B, NULL, scratch))
        return STEWART_RICCATI_FAILURE;
    stewart_subtract_offset(period, fraction, held->change[0], B + 6 * U, error);
    return 0;
}

int stewart_gain_scratch(const stewart_cost *cost, int pending)
{
    const int n = stewart_order(cost, pending), sampling = 9 * X * X + 3 * X * U;
    const int solving = stewart_lqr_scratch(n);
    return 2 * n * n + n * U + U * U + (sampling > solving ? sampling : solving);
}

int stewart_gain(const stewart_cost *cost, real period, real fraction, const real *A, const real *B,
                 const real *weights, real *K, stewart_scratch scratch)
{
    const int n = stewart_order(cost, fraction > 0);
    SampledModel m = {.n = n};
    m.A = stewart_take(&scratch, n * n);
    m.B = stewart_take(&scratch, n * U);
    m.Q = stewart_take(&scratch, n * n);
    m.R = stewart_take(&scratch, U * U);
    sample(cost, period, fraction, weights, A, B, &m, scratch);
    return solve_gain(&m, fraction > 0, K, scratch) ? 0 : STEWART_RICCATI_FAILURE;
}

void stewart_feed_back(const stewart_cost *cost, const real *K, const real *error,
                       const real *integral, int pending, const real *pending_torques, const real *feedforward,
                       real *torque)
{
    for (int i = 0; i < U; i++) {
        for (int j = 0; j < X; j++)
            torque[i] -= *K++ * error[j];
        for (int j = 0; cost->integrates && j < 6; j++)
            torque[i] -= *K++ * integral[j];
        for (int j = 0; j < U * pending; j++)
            torque[i] -= *K++ * (pending_torques[j] - feedforward[j]);
    }
}
