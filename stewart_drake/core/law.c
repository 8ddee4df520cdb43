/* The predictive LQI law: see stewart.h. law/predictive_lqi.py and its parts are the reference, with
   the derivations; names and order of operations are theirs. */

#include <limits.h>
#include <string.h>

#include "stewart.h"

#define X STEWART_STATES
#define THETA STEWART_ESTIMATED
#define ALL STEWART_MEANS
#define U STEWART_MOTORS
#define ROW STEWART_REFERENCE

/* law/nominal.py */
#define VIGOROUS 2
/* law/sensing.py */
#define MOVED ((real)1e-3)
#define NOISY ((real)1048576)
#define SIGMAS 6
#define STEEPEST ((real)1.5707963267948966)
/* law/parameter_filter.py */
#define ITERATIONS 4
#define SMALL ((real)0.1)
#define KNOWN ((real)0.01)
#define LEARNT ((real)0.3)
#define PATIENCE 3
/* law/motion.py */
#define FURTHER ((real)1.25)
#define DOUBLINGS 6
/* law/catch_up.py */
#define CATCH_UP ((real)0.3)
/* dynamics/equations.py */
#define DEAD_CENTRE_SINE ((real)0.01)

static const real GAUSS_NODES[2] = {(real)0.21132486540518713, (real)0.7886751345948129};
static const real SQRT_3 = (real)1.7320508075688772;

/* ---- small matrices, by rows ------------------------------------------------------------------ */

/* C = A B, (n, k) (k, m); all sizes are multiples of 4 or 6 but the ones of `solve`. */
static void multiply(int n, int k, int m, const real *A, const real *B, real *restrict C)
{
    for (int i = 0; i < n; i++) {
        real *restrict c = C + m * i;
        for (int j = 0; j < m; j++)
            c[j] = 0;
        for (int p = 0; p < k; p++) {
            real a = A[k * i + p];
            for (int j = 0; j < m; j++)
                c[j] += a * B[m * p + j];
        }
    }
}

/* C = A B', (n, k) (m, k)'. */
static void multiply_by_transpose(int n, int k, int m, const real *A, const real *B,
                                  real *restrict C)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++) {
            real sum = 0;
            for (int p = 0; p < k; p++)
                sum += A[k * i + p] * B[k * j + p];
            C[m * i + j] = sum;
        }
}

/* B <- A^-1 B, (n, n) (n, m), by elimination with row pivoting; A is lost. 0 for a singular A. */
static int solve(int n, int m, real *A, real *restrict B)
{
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (REAL(fabs)(A[n * i + k]) > REAL(fabs)(A[n * best + k]))
                best = i;
        if (!(REAL(fabs)(A[n * best + k]) > 0)) /* or NaN */
            return 0;
        for (int j = 0; j < n; j++) {
            real a = A[n * best + j];
            A[n * best + j] = A[n * k + j];
            A[n * k + j] = a;
        }
        for (int j = 0; j < m; j++) {
            real b = B[m * best + j];
            B[m * best + j] = B[m * k + j];
            B[m * k + j] = b;
        }
        for (int i = k + 1; i < n; i++) {
            real f = A[n * i + k] / A[n * k + k];
            for (int j = k + 1; j < n; j++)
                A[n * i + j] -= f * A[n * k + j];
            for (int j = 0; j < m; j++)
                B[m * i + j] -= f * B[m * k + j];
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++)
            for (int j = 0; j < m; j++)
                B[m * i + j] -= A[n * i + k] * B[m * k + j];
        for (int j = 0; j < m; j++)
            B[m * i + j] /= A[n * i + i];
    }
    return 1;
}

static int all_finite(int n, const real *x)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

static int all_equal(int n, const real *x, const real *y)
{
    for (int i = 0; i < n; i++)
        if (!(x[i] == y[i])) /* or NaN */
            return 0;
    return 1;
}

static void copy(int n, const real *from, real *to) { memcpy(to, from, (size_t)n * sizeof(real)); }

static void fill(int n, real value, real *x)
{
    for (int i = 0; i < n; i++)
        x[i] = value;
}

/* Phi = exp(A), S = int_0^1 exp(A s) ds B, of A (12, 12) and B (12, m).

   With phi(A) = sum A^k / (k+1)!,  exp(A) = 1 + A phi(A) and S = phi(A) B. The sum is taken for
   |A| / 2^s <= 1/2 up to k = 11, in blocks of three, and then doubled s times:
   S <- (1 + Phi) S, Phi <- Phi^2. */
static void exponential(int m, const real *A, const real *B, real *Phi, real *S,
                        stewart_workspace *w)
{
    static const real factorials[12] = {1,     2,      6,       24,      120,      720,
                                        5040,  40320,  362880,  3628800, 39916800, 479001600};
    real *A1 = w->power[0], *A2 = w->power[1], *A3 = w->power[2], *sum = w->power[3];
    real *next = w->power[4], size = 0, scale = 1;
    int doublings = 0;
    for (int j = 0; j < X; j++) {
        real column = 0;
        for (int i = 0; i < X; i++)
            column += REAL(fabs)(A[X * i + j]);
        size = column > size ? column : size;
    }
    for (; size * scale > (real)0.5 && doublings < 60; doublings++)
        scale /= 2;
    for (int i = 0; i < X * X; i++)
        A1[i] = scale * A[i];
    multiply(X, X, X, A1, A1, A2);
    multiply(X, X, X, A2, A1, A3);
    fill(X * X, 0, sum);
    for (int block = 9; block >= 0; block -= 3) {
        multiply(X, X, X, sum, A3, next);
        const real *f = factorials + block;
        for (int i = 0; i < X * X; i++)
            sum[i] = next[i] + A1[i] / f[1] + A2[i] / f[2];
        for (int i = 0; i < X; i++)
            sum[(X + 1) * i] += 1 / f[0];
    }
    multiply(X, X, X, A1, sum, Phi);
    for (int i = 0; i < X; i++)
        Phi[(X + 1) * i] += 1;
    multiply(X, X, m, sum, B, S);
    for (int i = 0; i < X * m; i++)
        S[i] *= scale;
    for (; doublings > 0; doublings--) {
        multiply(X, X, m, Phi, S, next);
        for (int i = 0; i < X * m; i++)
            S[i] += next[i];
        multiply(X, X, X, Phi, Phi, next);
        copy(X * X, next, Phi);
    }
}

/* ---- the machine ------------------------------------------------------------------------------ */

/* What is known of it, with the estimated parameters in the place of those known beforehand. */
typedef struct {
    stewart_plant plant;
    real parameters[STEWART_PARAMETERS];
} belief;

static void believe(const stewart_config *c, const real *estimated, belief *b)
{
    copy(STEWART_PARAMETERS, c->parameters, b->parameters);
    copy(THETA, estimated, b->parameters);
    b->plant.geometry = c->geometry;
    b->plant.gravity = &c->gravity;
    b->plant.parameters = b->parameters;
}

/* By how much each leg could still be moved before it cannot be closed, and is that `above` zero? */
static int within_reach(const stewart_config *c, const real *pose, int strictly)
{
    const real *g = c->geometry;
    real sines[3], cosines[3];
    for (int i = 0; i < 3; i++) {
        sines[i] = REAL(sin)(pose[i]);
        cosines[i] = REAL(cos)(pose[i]);
    }
    real cf = cosines[0], ct = cosines[1], cp = cosines[2], sf = sines[0], st = sines[1];
    real sp = sines[2];
    real R[3][3] = {{cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf},
                    {sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf},
                    {-st, ct * sf, ct * cf}};
    for (int leg = 0; leg < 6; leg++) {
        const real *own = g + leg;
        real crank = own[0], rod = own[6], p[3], q[3];
        for (int i = 0; i < 3; i++) {
            p[i] = pose[3 + i] - own[6 * (15 + i)];
            for (int j = 0; j < 3; j++)
                p[i] += R[i][j] * own[6 * (12 + j)];
        }
        for (int j = 0; j < 3; j++) { /* in the motor's frame, whose axes are columns */
            q[j] = 0;
            for (int i = 0; i < 3; i++)
                q[j] += own[6 * (3 + 3 * j + i)] * p[i];
        }
        real rho = REAL(hypot)(q[0], q[1]), shortest = REAL(hypot)(rho - crank, q[2]);
        real longest = REAL(hypot)(rho + crank, q[2]);
        real margin = rod - shortest < longest - rod ? rod - shortest : longest - rod;
        if (!(strictly ? margin > 0 : margin >= 0)) /* or NaN */
            return 0;
    }
    return 1;
}

static int at_limit(const stewart_config *c, int torques, const real *torque)
{
    for (int i = 0; i < U * torques; i++)
        if (REAL(fabs)(torque[i]) >= c->torque_limit)
            return 1;
    return 0;
}

static int substeps_for(const stewart_config *c, int torques, const real *torque)
{
    for (int i = 0; i < U * torques; i++)
        if (REAL(fabs)(torque[i]) > c->gentle_torque)
            return VIGOROUS * c->substeps;
    return c->substeps;
}

/* The state after `duration` seconds of a torque. */
static void move(const stewart_plant *plant, const real *torque, real duration, int substeps,
                 real *state)
{
    for (int i = 0; i < substeps; i++)
        stewart_move(plant, torque, duration / (real)substeps, state);
}

/* d[accelerations]/d[state, torque, parameters] at a point: A (12, 12), B (12, 6), G (12, 8) of the
   state; G may be NULL. 0 where they do not exist. */
static int derivatives(const stewart_plant *plant, const real *state, const real *torque, real *A,
                       real *B, real *G, stewart_workspace *w)
{
    const int columns = X + U + THETA;
    real accelerations[6];
    stewart_accelerations(plant, state, state + 6, torque, accelerations);
    stewart_residual_derivatives(plant, state, state + 6, accelerations, torque, w->dF_dx, w->dF_dp,
                                 w->M, w->arm);
    real mass[36];
    for (int i = 0; i < 6; i++) {
        real *row = w->right + columns * i;
        for (int j = 0; j < 6; j++)
            mass[6 * i + j] = w->M[6 * j + i];
        for (int j = 0; j < X; j++)
            row[j] = -w->dF_dx[6 * j + i];
        for (int j = 0; j < U; j++)
            row[X + j] = w->arm[6 * i + j];
        for (int j = 0; j < THETA; j++)
            row[X + U + j] = -w->dF_dp[6 * j + i];
    }
    if (!solve(6, columns, mass, w->right))
        return 0;
    fill(6 * X, 0, A);
    fill(6 * U, 0, B);
    if (G)
        fill(6 * THETA, 0, G);
    for (int i = 0; i < 6; i++) {
        const real *row = w->right + columns * i;
        A[X * i + 6 + i] = 1;
        copy(X, row, A + X * (6 + i));
        copy(U, row + X, B + U * (6 + i));
        if (G)
            copy(THETA, row + X + U, G + THETA * (6 + i));
    }
    return 1;
}

/* ---- torques in flight: law/timeline.py ------------------------------------------------------- */

int stewart_queue_length(const stewart_config *c) { return c->steps + (c->fraction > 0); }

static int in_flight_length(const stewart_config *c)
{
    return 1 + c->kept + stewart_queue_length(c);
}

/* What acts in a period that begins with the oldest of some torques: one, or two of them. */
typedef struct {
    int torques;
    const real *torque;
    real durations[2];
} period;

static period period_of(const stewart_config *c, const real *torques)
{
    period p = {1, torques, {c->period, 0}};
    if (c->fraction > 0) {
        p.torques = 2;
        p.durations[0] = c->fraction * c->period;
        p.durations[1] = (1 - c->fraction) * c->period;
    }
    return p;
}

static void move_period(const stewart_plant *plant, const period *p, int substeps, real *state)
{
    for (int i = 0; i < p->torques; i++)
        move(plant, p->torque + U * i, p->durations[i], substeps, state);
}

int stewart_preview_times(const stewart_config *c, real *times)
{
    int n = 0, pending = c->fraction > 0;
    real delay = ((real)c->steps + c->fraction) * c->period;
    times[n++] = 0;
    for (int k = 1; k <= c->steps; k++)
        times[n++] = c->period * (real)k;
    for (int hold = -pending - 1; hold <= 1; hold++)
        for (int node = 0; node < 2; node++)
            times[n++] = delay + c->period * ((real)hold + GAUSS_NODES[node]);
    return n;
}

/* ---- the filter: law/parameter_filter.py ------------------------------------------------------ */

/* The last period, as far as the delay is what it is believed to be. */
typedef struct {
    const stewart_config *config;
    period acting;
    const real *following; /* torque that acts next */
    int substeps;
} interval;

static void start_estimate(const stewart_config *c, const real *measurement, const real *theta,
                           stewart_estimate *e)
{
    copy(X, measurement, e->mean);
    memmove(e->mean + X, theta, THETA * sizeof(real));
    fill(ALL * ALL, 0, e->covariance);
    for (int i = 0; i < X; i++)
        e->covariance[(ALL + 1) * i] = c->noise_std[i] * c->noise_std[i];
    for (int i = 0; i < THETA; i++)
        e->covariance[(ALL + 1) * (X + i)] = c->std[i] * c->std[i];
}

static int is_known(const stewart_config *c, const real *covariance, real share)
{
    for (int i = 0; i < THETA; i++)
        if (!(REAL(sqrt)(covariance[(ALL + 1) * (X + i)]) <= share * c->std[i])) /* or NaN */
            return 0;
    return 1;
}

/* The state when the share s of h seconds is over: the cubic through both ends. */
static void within_hold(const real *start, const real *end, real h, real s, real *state)
{
    real left = 1 - s;
    for (int i = 0; i < 6; i++) {
        real rise = (end[i] - start[i]) / h, a = start[6 + i] - rise, b = end[6 + i] - rise;
        state[i] = left * start[i] + s * end[i] + h * s * left * (left * a - s * b);
        state[6 + i] = rise + left * (1 - 3 * s) * a + s * (3 * s - 2) * b;
    }
}

/* [hold, hold_S] of one torque that leads from `start` to `end` in h seconds. */
static int transition_of_hold(const stewart_plant *plant, const real *torque, real h, int exact,
                              const real *start, const real *end, stewart_workspace *w)
{
    stewart_filter_work *f = &w->part.filter;
    real state[X];
    for (int node = 0; node < 1 + exact; node++) {
        within_hold(start, end, h, exact ? GAUSS_NODES[node] : (real)0.5, state);
        if (!derivatives(plant, state, torque, f->A[node], f->B, f->G[node], w))
            return 0;
    }
    if (exact) { /* h/2 (L1 + L2) + sqrt(3)/12 h^2 [L2, L1], L = [A G; 0 0] */
        real part = SQRT_3 / 12 * h * h;
        multiply(X, X, X, f->A[1], f->A[0], w->power[0]);
        multiply(X, X, X, f->A[0], f->A[1], w->power[1]);
        multiply(X, X, THETA, f->A[1], f->G[0], w->power[2]);
        multiply(X, X, THETA, f->A[0], f->G[1], w->power[3]);
        for (int i = 0; i < X * X; i++)
            f->omega[i] = h / 2 * (f->A[0][i] + f->A[1][i]) + part * (w->power[0][i] - w->power[1][i]);
        for (int i = 0; i < X * THETA; i++)
            f->turned[i] = h / 2 * (f->G[0][i] + f->G[1][i]) + part * (w->power[2][i] - w->power[3][i]);
    } else {
        for (int i = 0; i < X * X; i++)
            f->omega[i] = h * f->A[0][i];
        for (int i = 0; i < X * THETA; i++)
            f->turned[i] = h * f->G[0][i];
    }
    exponential(THETA, f->omega, f->turned, f->hold, f->hold_S, w);
    return 1;
}

/* The state after the period from xi = [state; parameters], and H = [Phi S] (12, 20). */
static int transition(const interval *t, const real *xi, int exact, real *after,
                      stewart_workspace *w)
{
    stewart_filter_work *f = &w->part.filter;
    belief b;
    real start[X];
    believe(t->config, xi + X, &b);
    copy(X, xi, after);
    for (int k = 0; k < t->acting.torques; k++) {
        const real *torque = t->acting.torque + U * k;
        copy(X, after, start);
        move(&b.plant, torque, t->acting.durations[k], t->substeps, after);
        if (!transition_of_hold(&b.plant, torque, t->acting.durations[k], exact, start, after, w))
            return 0;
        if (k > 0) { /* [hold hold_S; 0 1] [H; 0 1] */
            multiply(X, X, ALL, f->hold, f->H, f->HP);
            copy(X * ALL, f->HP, f->H);
        }
        for (int i = 0; i < X; i++) {
            if (k == 0)
                copy(X, f->hold + X * i, f->H + ALL * i);
            for (int j = 0; j < THETA; j++) {
                real *s = f->H + ALL * i + X + j;
                *s = (k > 0 ? *s : 0) + f->hold_S[THETA * i + j];
            }
        }
    }
    return 1;
}

/* Squares of the change of the last state per s by which a change of torque comes early, summed. */
static void kicks(const interval *t, const real *state, const real *theta, real *squares)
{
    belief b;
    real before[6], after[6], left = t->acting.durations[0] + t->acting.durations[1];
    believe(t->config, theta, &b);
    fill(X, 0, squares);
    stewart_accelerations(&b.plant, state, state + 6, t->acting.torque, before);
    for (int k = 0; k < t->acting.torques; k++) {
        const real *next = k + 1 < t->acting.torques ? t->acting.torque + U * (k + 1) : t->following;
        stewart_accelerations(&b.plant, state, state + 6, next, after);
        left -= t->acting.durations[k];
        for (int i = 0; i < 6; i++) {
            real change = after[i] - before[i];
            squares[i] += left * change * left * change;
            squares[6 + i] += change * change;
            before[i] = after[i];
        }
    }
}

/* The nearest mean, as the covariance measures it, with each parameter in its bounds. */
static int within_bounds(const stewart_config *c, const real *mean, const real *P, real *moved)
{
    int fixed[THETA], at_upper[THETA], n = 0;
    real held[THETA], push[THETA], factors[THETA * THETA];
    copy(ALL, mean, moved);
    for (int round = 0; round < 4 * THETA; round++) {
        int worst = 0;
        real furthest = -1, value = 0;
        for (int i = 0; i < THETA; i++) {
            real x = moved[X + i];
            real inside = x < c->lower[i] ? c->lower[i] : x > c->upper[i] ? c->upper[i] : x;
            real excess = REAL(fabs)(x - inside) / REAL(sqrt)(P[(ALL + 1) * (X + i)]);
            if (isnan(excess))
                return 0;
            if (excess > furthest) {
                furthest = excess;
                worst = i;
                value = inside;
            }
        }
        if (furthest <= (real)1e-9)
            break;
        int place = 0;
        while (place < n && fixed[place] != worst)
            place++;
        fixed[place] = worst;
        held[place] = value;
        at_upper[place] = value == c->upper[worst];
        n += place == n;
        for (;;) { /* free those that are held back from inside */
            if (n == 0)
                return 0;
            for (int i = 0; i < n; i++) {
                push[i] = mean[X + fixed[i]] - held[i];
                for (int j = 0; j < n; j++)
                    factors[n * i + j] = P[ALL * (X + fixed[i]) + X + fixed[j]];
            }
            if (!solve(n, 1, factors, push) || !all_finite(n, push))
                return 0;
            int least = 0;
            for (int i = 1; i < n; i++)
                if ((at_upper[i] ? push[i] : -push[i]) < (at_upper[least] ? push[least] : -push[least]))
                    least = i;
            if ((at_upper[least] ? push[least] : -push[least]) >= 0)
                break;
            n--;
            for (int i = least; i < n; i++) {
                fixed[i] = fixed[i + 1];
                held[i] = held[i + 1];
                at_upper[i] = at_upper[i + 1];
            }
        }
        for (int i = 0; i < ALL; i++) {
            moved[i] = mean[i];
            for (int j = 0; j < n; j++)
                moved[i] -= P[ALL * i + X + fixed[j]] * push[j];
        }
    }
    for (int i = 0; i < THETA; i++) {
        real x = moved[X + i];
        moved[X + i] = x < c->lower[i] ? c->lower[i] : x > c->upper[i] ? c->upper[i] : x;
    }
    return 1;
}

/* Gain (20, 12), S and the posterior covariance, in Joseph's form, of H P H' + R. */
static int correct(const real *P, const real *R, stewart_filter_work *f)
{
    multiply(X, ALL, ALL, f->H, P, f->HP);
    multiply_by_transpose(X, ALL, X, f->HP, f->H, f->S);
    for (int i = 0; i < X; i++)
        f->S[(X + 1) * i] += R[i];
    copy(X * X, f->S, f->factors);
    if (!solve(X, ALL, f->factors, f->HP))
        return 0;
    for (int i = 0; i < X; i++)
        for (int j = 0; j < ALL; j++)
            f->gain[X * j + i] = f->HP[ALL * i + j];
    multiply(ALL, X, ALL, f->gain, f->H, f->keep);
    for (int i = 0; i < ALL * ALL; i++)
        f->keep[i] = (i % (ALL + 1) == 0) - f->keep[i];
    multiply(ALL, ALL, ALL, f->keep, P, f->product);
    multiply_by_transpose(ALL, ALL, ALL, f->product, f->keep, f->posterior);
    for (int i = 0; i < ALL; i++)
        for (int j = 0; j < X; j++)
            f->product[X * i + j] = f->gain[X * i + j] * R[j];
    for (int i = 0; i < ALL; i++)
        for (int j = 0; j < ALL; j++)
            for (int k = 0; k < X; k++)
                f->posterior[ALL * i + j] += f->product[X * i + k] * f->gain[X * j + k];
    return 1;
}

static int all_small(const real *x, const real *R)
{
    for (int i = 0; i < X; i++)
        if (!(REAL(fabs)(x[i]) <= SMALL * REAL(sqrt)(R[i])))
            return 0;
    return 1;
}

/* The iterations of the filter: xi and `after` move, H and the posterior follow; 0 where the
   measurement y does not fit. */
static int update(const interval *t, const stewart_estimate *prior, int exact, const real *y,
                  const real *R, real *xi, real *after, stewart_workspace *w)
{
    stewart_filter_work *f = &w->part.filter;
    real innovation[X], weighted[X], moved[ALL], shift[X], linear[X], mean[ALL];
    for (int round = 0; round < ITERATIONS; round++) {
        for (int i = 0; i < X; i++) {
            innovation[i] = y[i] - after[i];
            for (int j = 0; j < ALL; j++)
                innovation[i] -= f->H[ALL * i + j] * (prior->mean[j] - xi[j]);
        }
        if (!correct(prior->covariance, R, f))
            return 0;
        for (int i = 0; i < ALL; i++) {
            mean[i] = prior->mean[i];
            for (int j = 0; j < X; j++)
                mean[i] += f->gain[X * i + j] * innovation[j];
        }
        if (!within_bounds(t->config, mean, f->posterior, moved))
            return 0;
        for (int i = 0; i < X; i++) {
            shift[i] = 0;
            for (int j = 0; j < ALL; j++)
                shift[i] += f->H[ALL * i + j] * (moved[j] - xi[j]);
            linear[i] = after[i] + shift[i];
        }
        copy(ALL, moved, xi);
        if (all_small(shift, R)) {
            copy(X, linear, after);
            break;
        }
        belief b;
        believe(t->config, xi + X, &b);
        copy(X, xi, after);
        move_period(&b.plant, &t->acting, t->substeps, after);
        for (int i = 0; i < X; i++)
            shift[i] = after[i] - linear[i];
        if (all_small(shift, R))
            break;
        if (!transition(t, xi, exact, after, w))
            return 0;
    }
    real squared = 0;
    copy(X, innovation, weighted);
    copy(X * X, f->S, f->factors);
    if (!solve(X, 1, f->factors, weighted))
        return 0;
    for (int i = 0; i < X; i++)
        squared += innovation[i] * weighted[i];
    return squared <= t->config->gate; /* not for NaN */
}

/* `found` from a prior after one period and a measurement y, or NULL; 0 where it does not fit. */
static int attempt(const interval *t, const stewart_estimate *prior, const real *y,
                   stewart_estimate *found, stewart_workspace *w)
{
    const stewart_config *c = t->config;
    stewart_filter_work *f = &w->part.filter;
    real xi[ALL], after[X], drift[X], R[X], squares[X];
    const real *P = prior->covariance;
    int exact = !is_known(c, P, KNOWN);
    copy(ALL, prior->mean, xi);
    if (!transition(t, xi, exact, after, w))
        return 0;
    kicks(t, after, xi + X, squares);
    for (int i = 0; i < X; i++) {
        drift[i] = c->model_std[i] * c->model_std[i] + c->timing_std * c->timing_std * squares[i];
        R[i] = c->noise_std[i] * c->noise_std[i] + drift[i];
    }
    if (y) {
        if (!update(t, prior, exact, y, R, xi, after, w))
            return 0;
        P = f->posterior;
    }
    /* F P F' with F = [Phi S; 0 1] = [H; 0 1] */
    multiply(X, ALL, ALL, f->H, P, f->HP);
    multiply_by_transpose(X, ALL, X, f->HP, f->H, f->S);
    for (int i = 0; i < ALL; i++)
        for (int j = 0; j < ALL; j++) {
            real *to = found->covariance + ALL * i + j;
            if (i < X && j < X)
                *to = (f->S[X * i + j] + f->S[X * j + i]) / 2 + (i == j ? drift[i] : 0);
            else if (i < X)
                *to = f->HP[ALL * i + j];
            else if (j < X)
                *to = f->HP[ALL * j + i];
            else
                *to = (P[ALL * i + j] + P[ALL * j + i]) / 2;
        }
    copy(X, after, found->mean);
    copy(THETA, xi + X, found->mean + X);
    return all_finite(ALL * ALL, found->covariance) && all_finite(ALL, found->mean);
}

static void remember(stewart_memory *m, const stewart_estimate *e)
{
    copy(ALL, e->mean, m->mean);
    copy(ALL * ALL, e->covariance, m->covariance);
}

static void begin_anew(const stewart_config *c, stewart_memory *m, const real *y,
                       stewart_estimate *e)
{
    start_estimate(c, y, m->mean + X, e);
    remember(m, e);
    m->outliers = m->unseen = 0;
    m->has_covariance = 1;
}

/* One period, then a measurement y at its end, or NULL. */
static void advance(const interval *t, stewart_memory *m, const real *y, stewart_workspace *w)
{
    const stewart_config *c = t->config;
    stewart_filter_work *f = &w->part.filter;
    stewart_estimate *prior = &f->prior;
    copy(ALL, m->mean, prior->mean);
    copy(ALL * ALL, m->covariance, prior->covariance);
    if (!y) {
        m->unseen += m->unseen < INT_MAX;
        if (attempt(t, prior, NULL, &f->found, w)) {
            remember(m, &f->found);
            m->outliers = 0;
        }
        return;
    }
    if (attempt(t, prior, y, &f->found, w)) {
        if (m->unseen >= PATIENCE && !is_known(c, prior->covariance, LEARNT)) {
            begin_anew(c, m, y, prior);
            return;
        }
        remember(m, &f->found);
        m->outliers = m->unseen = 0;
        return;
    }
    int alone = attempt(t, prior, NULL, &f->alone, w), outliers = 1;
    if (m->outliers > 0) {
        start_estimate(c, m->outlier, m->mean + X, prior);
        if (attempt(t, prior, y, &f->found, w))
            outliers += m->outliers;
    }
    if (!alone || outliers >= PATIENCE) {
        begin_anew(c, m, y, prior);
        return;
    }
    remember(m, &f->alone);
    m->outliers = outliers;
    m->unseen += m->unseen < INT_MAX;
    copy(X, y, m->outlier);
}

/* ---- measurements: law/sensing.py, law/observers.py, law/late.py ------------------------------ */

static int fault_of(const stewart_config *c, const real *y, const real *last)
{
    if (!all_finite(X, y))
        return STEWART_MEASUREMENT_MISSING;
    for (int i = 0; i < X; i++) {
        real unit = REAL(nextafter)(REAL(fabs)(y[i]), (real)HUGE_VAL) - REAL(fabs)(y[i]);
        if (y[i] == last[i] && c->noise_std[i] > NOISY * unit)
            return STEWART_MEASUREMENT_FROZEN;
    }
    for (int i = 0; i < 6; i++) {
        real moved = c->period / 2 * REAL(fabs)(y[6 + i] + last[6 + i]);
        real perhaps = MOVED * c->motion[i] + SIGMAS * c->period * c->noise_std[6 + i];
        if (y[i] == last[i] && moved > perhaps)
            return STEWART_MEASUREMENT_FROZEN;
    }
    if (REAL(fabs)(y[1]) >= STEEPEST || !within_reach(c, y, 0))
        return STEWART_MEASUREMENT_REJECTED;
    return 0;
}

/* `mean` goes on by a period, whose torques begin at `torques`, to a measurement y, NULL for none. */
static int observe(const stewart_config *c, stewart_memory *m, const real *torques, const real *y,
                   stewart_workspace *w)
{
    static const int none = STEWART_MEASUREMENT_MISSING;
    real last[X];
    copy(X, m->measured, last);
    int fault = y ? fault_of(c, y, last) : none;
    for (int i = 0; y && i < X; i++)
        if (isfinite(y[i]))
            m->measured[i] = y[i];
    interval t = {c, period_of(c, torques), torques, 0};
    if (stewart_queue_length(c) > 0)
        t.following = torques + U;
    t.substeps = substeps_for(c, t.acting.torques, torques);
    if (c->estimates && m->has_covariance) {
        advance(&t, m, fault ? NULL : y, w);
        if (m->outliers > 0) {
            fault = STEWART_MEASUREMENT_REJECTED;
            if (y && all_equal(X, y, last)) { /* no second witness */
                fault = STEWART_MEASUREMENT_FROZEN;
                m->outliers = 0;
            }
        }
    } else if (fault) {
        if (all_finite(X, m->mean)) {
            belief b;
            believe(c, c->parameters, &b);
            move_period(&b.plant, &t.acting, t.substeps, m->mean);
        }
    } else if (c->estimates) {
        begin_anew(c, m, y, &w->part.filter.found);
    } else {
        copy(X, y, m->mean);
    }
    return fault;
}

/* `state` of now, from a measurement that is `age` periods old; what is wrong with it. */
static int estimate(const stewart_config *c, stewart_memory *m, const real *y, int age,
                    stewart_workspace *w)
{
    const int length = in_flight_length(c), queue = stewart_queue_length(c);
    int there = 0;
    for (int i = 0; i < X; i++)
        there |= isfinite(y[i]) != 0;
    there &= age >= 0;
    int fault = there ? 0 : STEWART_MEASUREMENT_MISSING;
    int wanted = there && age < c->longest_wait ? age : c->longest_wait;
    m->behind++;
    while (m->behind > wanted) {
        m->behind--;
        const real *since = m->in_flight[length - m->behind - queue - 1];
        int fresh = there && m->behind == age;
        int found = observe(c, m, since, fresh ? y : NULL, w);
        fault = fresh ? found : fault;
    }
    copy(X, m->mean, m->state);
    if (m->behind > 0 && all_finite(X, m->mean)) {
        belief b;
        believe(c, m->mean + X, &b);
        const real *first = m->in_flight[length - m->behind - queue];
        int torques = m->behind + (c->fraction > 0), substeps = substeps_for(c, torques, first);
        for (int k = 0; k < m->behind; k++) {
            period p = period_of(c, first + U * k);
            move_period(&b.plant, &p, substeps, m->state);
        }
    }
    return fault;
}

/* law/design_models.py */
static int is_workable(const stewart_config *c, const real *pose)
{
    real measures[STEWART_MEASURES];
    if (!within_reach(c, pose, 1))
        return 0;
    stewart_measures(c->geometry, pose, NULL, measures);
    for (int i = 0; i < 6; i++)
        if (measures[i] < DEAD_CENTRE_SINE)
            return 0;
    return 1;
}

/* ---- the reference: law/motion.py, law/return_path.py ------------------------------------------ */

/* The reference `later` s after a row of it (negative: before). It comes to rest with the rate w:
   da/dt = -2 w a - w^2 v, of accelerations a and rates v. That is (2 v + a / w) / w away; w doubles
   until the plate could go FURTHER. */
static void continued(const stewart_config *c, const real *from, real later, real w, real *row)
{
    for (int doubled = 0; doubled < DOUBLINGS; doubled++, w *= 2) {
        real pose[6];
        for (int i = 0; i < 6; i++)
            pose[i] = from[i] + FURTHER * (2 * from[6 + i] + from[12 + i] / w) / w;
        if (is_workable(c, pose))
            break;
    }
    real left = REAL(exp)(-w * later);
    for (int i = 0; i < 6; i++) {
        real v = from[6 + i], a = from[12 + i], b = a + w * v;
        row[i] = from[i] + (v * (1 - left) + b / w * (1 - left * (1 + w * later))) / w;
        row[6 + i] = left * (v + b * later);
        row[12 + i] = left * (a - w * b * later);
    }
}

/* The share s of the way between two rows that are h seconds apart: the polynomial of fifth order. */
static void between(const real *from, const real *to, real h, real s, real *row)
{
    for (int i = 0; i < 6; i++) {
        real v0 = h * from[6 + i], v1 = h * to[6 + i], a0 = h * h * from[12 + i];
        real a1 = h * h * to[12 + i], c2 = a0 / 2, d = to[i] - from[i] - v0 - c2, e = v1 - v0 - a0;
        real f = a1 - a0, c3 = 10 * d - 4 * e + f / 2, c4 = -15 * d + 7 * e - f;
        real c5 = 6 * d - 3 * e + f / 2;
        row[i] = from[i] + s * (v0 + s * (c2 + s * (c3 + s * (c4 + s * c5))));
        row[6 + i] = (v0 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h;
        row[12 + i] = (2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / (h * h);
    }
}

/* Accelerations from rates v and the rows before and after, `later` s away, unless one is next to it:
   (v1 - v) / h = (a + a1) / 2. */
static void slopes(const real *const next[2], const real later[2], const real *v, real closest,
                   real *accelerations)
{
    int sides = 0;
    real sum[6] = {0};
    for (int side = 0; side < 2; side++)
        if (next[side] && REAL(fabs)(later[side]) < closest)
            return;
        else if (next[side] && ++sides)
            for (int i = 0; i < 6; i++)
                sum[i] += 2 * (next[side][6 + i] - v[i]) / later[side] - next[side][12 + i];
    for (int i = 0; i < 6; i++)
        accelerations[i] = sum[i] / (real)sides;
}

/* The given preview from `since` s on, in which what is missing of a row lies between the rows next to it
   in time, of this preview or the last one, or continues one of them. As long as there is none it stays
   missing. */
static void complete(const stewart_config *c, int n, const real *times, const real *given, real since,
                     real last[][ROW], real *preview)
{
    real found[ROW];
    const real rate = 2 / (((real)c->steps + c->fraction + 1) * c->period);
    for (int i = 0; i < n; i++)
        if (times[i] < since)
            fill(ROW, (real)NAN, preview + ROW * i);
        else
            copy(ROW, given + ROW * i, preview + ROW * i);
    const int missing = !all_finite(ROW * n, preview);
    for (int i = 0; missing && i < n; i++) {
        const real *next[2] = {NULL, NULL}; /* before and after */
        real later[2] = {-(real)HUGE_VAL, (real)HUGE_VAL};
        for (int j = 0; j < 2 * n - 1; j++) {
            int earlier = j >= n, k = earlier ? j - n + 1 : j;
            const real *source = earlier ? last[k - 1] : given + ROW * k;
            real gap = times[k] - times[i] - (earlier ? c->period : 0);
            int side = gap > 0, there = earlier || times[k] >= since;
            if (there && (side ? gap < later[1] : gap > later[0]) && all_finite(ROW, source)) {
                next[side] = source;
                later[side] = gap;
            }
        }
        if (next[0] && next[1])
            between(next[0], next[1], later[1] - later[0], later[0] / (later[0] - later[1]), found);
        else if (next[0] || next[1])
            continued(c, next[!next[0]], -later[!next[0]], rate, found);
        else
            break;
        real *row = preview + ROW * i;
        if (all_finite(6, row + 6))
            slopes(next, later, row + 6, c->period / 20, found + 12);
        for (int k = 0; k < ROW; k++)
            if (!isfinite(row[k]))
                row[k] = found[k];
    }
}

/* An offset from the reference that is zero after some holds: law/return_path.py. */
typedef struct {
    real offset[X];
    int holds;
} return_path;

/* The offset and its accelerations `time` s later, within the first hold of h s. */
static void move_offset(return_path *p, real h, real time, real *accelerations)
{
    const real n = (real)p->holds;
    for (int i = 0; i < 6; i++) {
        real *pose = p->offset + i, *rate = pose + 6, a = -*rate / (n * h);
        if (p->holds > 1)
            a -= 6 * (*pose + n * h / 2 * *rate) / (h * h * n * (n + 1));
        *pose += time * (*rate + time / 2 * a);
        *rate += time * a;
        accelerations[i] = a;
    }
}

/* Adds the offset `time` s after its beginning to a row of the reference. */
static void add_offset(return_path p, real h, real time, real *row)
{
    real a[6];
    for (; p.holds > 0 && time > h; p.holds--, time -= h)
        move_offset(&p, h, h, a);
    if (p.holds == 0)
        return;
    move_offset(&p, h, time, a);
    for (int i = 0; i < X; i++)
        row[i] += p.offset[i];
    for (int i = 0; i < 6; i++)
        row[X + i] += a[i];
}

/* The reference at an instant, between the rows before and after it. */
static void interpolate(int n, const real *times, const real *reference, real time, real *row)
{
    int before = 0, after = 0;
    real earlier = -(real)HUGE_VAL, later = (real)HUGE_VAL;
    for (int i = 0; i < n; i++) {
        real gap = times[i] - time;
        if (gap <= 0 && gap > earlier) {
            earlier = gap;
            before = i;
        } else if (gap > 0 && gap < later) {
            later = gap;
            after = i;
        }
    }
    between(reference + ROW * before, reference + ROW * after, later - earlier,
            earlier / (earlier - later), row);
}

/* Rows of the predicted motion, and the state where the next torque acts. */
static void predict_way(const stewart_config *c, const stewart_memory *m, int n, const real *times,
                        real *way, real *state)
{
    const int queue = stewart_queue_length(c);
    const real *torque = m->in_flight[in_flight_length(c) - queue];
    const int substeps = substeps_for(c, queue, torque);
    real ends[2][ROW], begin = 0;
    belief b;
    believe(c, m->mean + X, &b);
    copy(X, m->state, ends[1]);
    for (int k = 0; k < queue; k++, torque += U) {
        real h = k == 0 && c->fraction > 0 ? c->fraction * c->period : c->period;
        copy(X, ends[1], ends[0]);
        move(&b.plant, torque, h, substeps, ends[1]);
        for (int end = 0; end < 2; end++)
            stewart_accelerations(&b.plant, ends[end], ends[end] + 6, torque, ends[end] + X);
        for (int i = 0; i < n; i++)
            if (times[i] >= begin && times[i] < begin + h)
                between(ends[0], ends[1], h, (times[i] - begin) / h, way + ROW * i);
        begin += h;
    }
    for (int i = 0; i < n; i++)
        if (times[i] < 0 || times[i] >= begin) {
            copy(X, ends[1], way + ROW * i);
            fill(6, 0, way + ROW * i + X);
        }
    copy(X, ends[1], state);
}

/* `preview` of the workspace, what is followed: the given reference, and after a gap the way back onto it.
   The status. law/predictive_lqi.py: _previewed. */
static int follow(const stewart_config *c, stewart_memory *m, const real *given,
                  stewart_workspace *w)
{
    const real h = c->period, eta = ((real)c->steps + c->fraction) * h, acts = eta - (real)1e-6 * h;
    real times[STEWART_PREVIEW], wanted[ROW], reached[ROW], a[6], *reference = w->reference;
    const int n = stewart_preview_times(c, times), missing = !all_finite(ROW * n, given);
    const int gap = !all_finite(ROW, given + ROW * (n - 1)), ended = m->gap && !gap;
    const int known = all_finite(ROW, m->followed[n - 2]);
    return_path p = {{0}, m->return_holds};
    copy(X, m->offset, p.offset);
    if (p.holds > 0) {
        move_offset(&p, h, h, a);
        p.holds--;
    } else {
        m->return_samples -= m->return_samples > 0;
    }
    complete(c, n, times, given, -(real)HUGE_VAL, m->reference, reference);
    copy(ROW * n, reference, w->preview);
    if (ended || p.holds + m->return_samples > 0) {
        const int quiet = m->silence > 0 && !at_limit(c, in_flight_length(c), m->in_flight[0]);
        const int early = ended || 2 * (real)p.holds * h >= CATCH_UP;
        const int corrected = early && !missing && quiet, predicted = corrected || !known;
        int returns = 1, holds = (int)REAL(ceil)(CATCH_UP / h - (real)1e-6);
        if (!predicted) {
            complete(c, n, times, reference, acts, m->followed, w->preview);
            if (ended) { /* without a step in what is followed */
                fill(ROW, 0, reached);
                add_offset(p, h, 0, reached);
                complete(c, n, times, given, (real)HUGE_VAL, m->reference, w->way);
                interpolate(n, times, w->way, eta, wanted);
                for (int i = 0; i < X; i++)
                    reached[i] += wanted[i];
            }
        } else if (all_finite(X, m->state)) {
            predict_way(c, m, n, times, w->preview, reached);
        } else { /* nothing else to go on with */
            returns = p.holds = m->return_samples = 0;
        }
        if (returns && (ended || predicted)) {
            interpolate(n, times, reference, eta, wanted);
            for (int i = 0; i < X; i++)
                p.offset[i] = reached[i] - wanted[i];
        }
        if (returns && (ended || !known)) {
            p.holds = holds > 2 ? holds : 2;
            m->return_samples = stewart_queue_length(c) + 2;
        }
        for (int i = 0; returns && i < n; i++)
            if (times[i] >= acts) {
                copy(ROW, reference + ROW * i, w->preview + ROW * i);
                add_offset(p, h, times[i] - eta, w->preview + ROW * i);
            }
    }
    m->gap = gap;
    m->return_holds = p.holds;
    copy(X, p.offset, m->offset);
    for (int i = 1; i < n; i++) {
        copy(ROW, reference + ROW * i, m->reference[i - 1]);
        copy(ROW, w->preview + ROW * i, m->followed[i - 1]);
    }
    return missing ? STEWART_REFERENCE_MISSING : 0;
}

/* ---- the law: law/predictive_lqi.py and its parts --------------------------------------------- */

/* Where the next torque acts. */
typedef struct {
    real state[X], error[X], integral[6];
} ahead;

/* Torques that are held, of that which is still to act and of the next; and changes over holds. */
typedef struct {
    real torque[2][U], change[4][U];
} held;

/* law/feedforward.py, law/holds.py: from the reference at two nodes of each hold. */
static void feed_forward(const stewart_config *c, const real *theta, const real *nodes, held *h)
{
    const int holds = 3 + (c->fraction > 0);
    real mean[4][U], at[2][U];
    belief b;
    believe(c, theta, &b);
    for (int k = 0; k < holds; k++) {
        for (int node = 0; node < 2; node++) {
            const real *r = nodes + ROW * (2 * k + node);
            stewart_inverse_dynamics(&b.plant, r, r + 6, r + 12, at[node]);
        }
        for (int i = 0; i < U; i++) {
            mean[k][i] = (at[0][i] + at[1][i]) / 2;
            h->change[k][i] = SQRT_3 * (at[1][i] - at[0][i]);
        }
    }
    for (int k = 1; k < holds - 1; k++)
        for (int i = 0; i < U; i++)
            h->torque[k - 1][i] = mean[k][i] - (h->change[k + 1][i] - h->change[k - 1][i]) / 24;
}

/* law/predictors.py: the exact equations over `steps` periods. */
static void predict(const stewart_config *c, const stewart_memory *m, const real *queue,
                    const real *preview, const real *integral, ahead *a)
{
    belief b;
    real before[6];
    believe(c, m->mean + X, &b);
    copy(X, m->state, a->state);
    copy(6, integral, a->integral);
    for (int i = 0; i < 6; i++)
        before[i] = m->state[i] - preview[i];
    int substeps = substeps_for(c, stewart_queue_length(c), queue);
    for (int k = 0; k < c->steps; k++) {
        period p = period_of(c, queue + U * k);
        const real *wanted = preview + ROW * (k + 1);
        move_period(&b.plant, &p, substeps, a->state);
        int waits = at_limit(c, p.torques, p.torque);
        for (int i = 0; i < 6; i++) {
            real error = a->state[i] - wanted[i];
            if (!waits)
                a->integral[i] += c->period / 2 * (before[i] + error);
            before[i] = error;
        }
    }
    for (int i = 0; i < X; i++)
        a->error[i] = a->state[i] - preview[ROW * c->steps + i];
}

/* Where held torques put pose and rates at the sample whose error is regulated; B of the model. */
static void subtract_offset(const stewart_config *c, const held *h, const real *B, real *error)
{
    real passed = 1 - c->fraction, left = passed * (1 - passed);
    for (int i = 0; i < 6; i++) {
        real push = 0;
        for (int j = 0; j < U; j++) {
            real change = c->fraction > 0 ? h->change[1][j] : h->change[0][j] + h->change[1][j];
            push -= c->period * B[U * (6 + i) + j] * change;
        }
        if (c->fraction > 0) {
            error[i] -= c->period * left * (1 - 2 * passed) / 12 * push;
            error[6 + i] -= ((real)1 / 12 - left / 2) * push;
        } else {
            error[6 + i] -= push / 24;
        }
    }
}

/* law/delay_model.py: error, integral and the torque that is still to act, sampled. The number of
   states; A, B and the diagonals of Q and R are in the workspace. */
static int sample(const stewart_config *c, const real *weights, stewart_workspace *w)
{
    const int pending = c->fraction > 0, n = X + 6 + U * pending;
    real *A = w->order_A, *B = w->order_B, *Q = w->order_Q, half = c->period / 2;
    for (int part = 0; part < 1 + pending; part++) { /* after eta0, before it */
        real h = (part == 0 ? 1 - c->fraction : c->fraction) * c->period;
        real scaled[X * X], pushed[X * U];
        for (int i = 0; i < X * X; i++)
            scaled[i] = h * w->A[i];
        for (int i = 0; i < X * U; i++)
            pushed[i] = h * w->B[i];
        exponential(U, scaled, pushed, w->phi[part], w->input[part], w);
    }
    if (pending) {
        multiply(X, X, U, w->phi[0], w->input[1], w->power[0]);
        copy(X * U, w->power[0], w->input[1]);
        multiply(X, X, X, w->phi[0], w->phi[1], w->power[0]);
        copy(X * X, w->power[0], w->phi[0]);
    }
    fill(n * n, 0, A);
    fill(n * U, 0, B);
    fill(n * n, 0, Q);
    fill(U * U, 0, w->R);
    for (int i = 0; i < X; i++) {
        copy(X, w->phi[0] + X * i, A + n * i);
        copy(U, w->input[0] + U * i, B + U * i);
        if (pending)
            copy(U, w->input[1] + U * i, A + n * i + X + 6);
    }
    for (int i = 0; i < 6; i++) { /* z+ = z + dt/2 (e + e+) */
        real *row = A + n * (X + i);
        for (int j = 0; j < X; j++)
            row[j] = half * ((real)(i == j) + w->phi[0][X * i + j]);
        row[X + i] = 1;
        for (int j = 0; j < U; j++) {
            B[U * (X + i) + j] = half * w->input[0][U * i + j];
            if (pending)
                row[X + 6 + j] = half * w->input[1][U * i + j];
        }
        if (pending)
            B[U * (X + 6 + i) + i] = 1;
        Q[(n + 1) * i] = weights[0] * c->error_weights[i];
        Q[(n + 1) * (X + i)] = weights[0] * c->integral_weights[i];
        w->R[(U + 1) * i] = weights[1] * c->torque_weights[i];
    }
    return n;
}

/* law/riccati.py: the gain (6, n) of what was sampled. Each state is measured in the size that costs
   one now and at the next sample together, each torque in that which costs one. */
static int design(int n, stewart_workspace *w, real *K)
{
    real x[STEWART_MAX_ORDER], u[U], *A = w->order_A, *B = w->order_B, *Q = w->order_Q;
    for (int i = 0; i < U; i++) {
        if (!(w->R[(U + 1) * i] > 0 && isfinite(w->R[(U + 1) * i])))
            return 0;
        u[i] = 1 / REAL(sqrt)(w->R[(U + 1) * i]);
    }
    for (int i = 0; i < n; i++) {
        real cost = Q[(n + 1) * i];
        if (!(cost >= 0))
            return 0;
        for (int j = 0; j < n; j++)
            cost += A[n * j + i] * Q[(n + 1) * j] * A[n * j + i];
        x[i] = cost > 0 && isfinite(cost) ? 1 / REAL(sqrt)(cost) : 1;
    }
    if (n > X + 6)
        copy(U, u, x + X + 6);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++)
            A[n * i + j] *= x[j] / x[i];
        for (int j = 0; j < U; j++)
            B[U * i + j] *= u[j] / x[i];
        Q[(n + 1) * i] *= x[i] * x[i];
    }
    for (int i = 0; i < U; i++)
        w->R[(U + 1) * i] *= u[i] * u[i];
    if (!all_finite(n * n, A) || !all_finite(n * U, B) || !all_finite(n * n, Q))
        return 0;
    if (!stewart_riccati(n, A, B, Q, w->R, K, NULL, &w->part.riccati) || !all_finite(U * n, K))
        return 0;
    for (int i = 0; i < U; i++)
        for (int j = 0; j < n; j++)
            K[n * i + j] *= u[i] / x[j];
    return 1;
}

/* The gain for where the torque acts, and the error that it multiplies; what went wrong. `use` says
   whether there is a gain, the new one or the last. */
static int find_gain(const stewart_config *c, const stewart_memory *m, const held *h, ahead *a,
                     const real *weights, stewart_workspace *w, int *use)
{
    belief b;
    int n = X + 6 + (c->fraction > 0 ? U : 0);
    believe(c, m->mean + X, &b);
    *use = 0;
    if (!is_workable(c, a->state))
        return STEWART_UNREACHABLE;
    const real *torque = h->torque[c->fraction > 0];
    if (derivatives(&b.plant, a->state, torque, w->A, w->B, NULL, w)) {
        subtract_offset(c, h, w->B, a->error);
        if (design(sample(c, weights, w), w, w->K)) {
            *use = 1;
            return 0;
        }
    }
    copy(U * n, m->gain, w->K);
    *use = m->has_gain;
    return STEWART_RICCATI_FAILURE;
}

/* T = T_ff - K [error; integral; torque that is still to act]. */
static int feed_back(const stewart_config *c, stewart_memory *m, const real *preview,
                     const real *nodes, const real *weights, stewart_workspace *w, real *torque)
{
    const int pending = c->fraction > 0, queue = stewart_queue_length(c);
    const int n = X + 6 + U * pending;
    const real *first = m->in_flight[in_flight_length(c) - queue];
    real error[6], seen[STEWART_MAX_ORDER];
    ahead a;
    held h;
    int use, waits = at_limit(c, 1 + pending, first - U);
    for (int i = 0; i < 6; i++) {
        error[i] = m->state[i] - preview[i];
        if (m->has_started && !waits)
            m->integral[i] += c->period / 2 * (m->error[i] + error[i]);
        m->error[i] = error[i];
    }
    predict(c, m, first, preview, m->integral, &a);
    feed_forward(c, m->mean + X, nodes, &h);
    int trouble = find_gain(c, m, &h, &a, weights, w, &use);
    copy(U, h.torque[pending], torque);
    copy(U, torque, m->feedforward);
    if (!use)
        return trouble;
    copy(X, a.error, seen);
    copy(6, a.integral, seen + X);
    for (int i = 0; pending && i < U; i++)
        seen[X + 6 + i] = first[U * (queue - 1) + i] - h.torque[0][i];
    for (int i = 0; i < U; i++)
        for (int j = 0; j < n; j++)
            torque[i] -= w->K[n * i + j] * seen[j];
    copy(U * n, w->K, m->gain);
    m->has_gain = 1;
    return trouble;
}

/* A torque in flight, if it is finite. */
static void keep(const real *torque, real *in_flight)
{
    if (all_finite(U, torque))
        copy(U, torque, in_flight);
}

void stewart_init(const stewart_config *c, stewart_memory *m, const real *queue)
{
    const int length = stewart_queue_length(c);
    memset(m, 0, sizeof *m);
    for (int i = 0; i < length; i++)
        keep(queue + U * i, m->in_flight[1 + c->kept + i]);
    copy(U, m->in_flight[c->kept + length], m->torque);
    fill(X, (real)NAN, m->mean);
    copy(THETA, c->estimates ? c->prior : c->parameters, m->mean + X);
    fill(ALL * ALL, (real)NAN, m->covariance);
    fill(X, (real)NAN, m->state);
    fill(X, (real)NAN, m->measurement);
    fill(X, (real)NAN, m->measured);
    fill(X, (real)NAN, m->outlier);
    fill(2, (real)NAN, m->weights);
    fill(U, (real)NAN, m->feedforward);
    fill(U * STEWART_MAX_ORDER, (real)NAN, m->gain);
    fill((STEWART_PREVIEW - 1) * ROW, (real)NAN, m->reference[0]);
    fill((STEWART_PREVIEW - 1) * ROW, (real)NAN, m->followed[0]);
    m->silence = c->silence;
}

int stewart_step(const stewart_config *c, stewart_memory *m, stewart_workspace *w,
                 const real *measurement, int age, const real *preview, const real *weights,
                 real *torque)
{
    const int length = in_flight_length(c);
    int status = estimate(c, m, measurement, age, w);
    status |= follow(c, m, preview, w);
    preview = w->preview;
    const real *nodes = preview + ROW * (1 + c->steps);
    const int waiting = !all_finite(ROW, nodes);
    if (status & STEWART_REFERENCE_MISSING && !waiting && !m->gap) /* which spoils the plan as a limit does */
        m->silence = 0;
    if (!all_finite(X, m->state)) { /* nothing else to go on with */
        copy(X, preview, m->state);
        if (m->behind == 0 && c->longest_wait == 0)
            copy(X, preview, m->mean);
    }
    if (waiting) { /* nothing to follow yet: hold the torque */
        copy(U, m->torque, torque);
        copy(U, torque, m->feedforward);
        fill(6, 0, m->error);
    } else if (m->silence > 0 && !at_limit(c, length, m->in_flight[0])) {
        held h;
        feed_forward(c, c->parameters, nodes, &h);
        copy(U, h.torque[c->fraction > 0], torque);
        copy(U, torque, m->feedforward);
        fill(6, 0, m->error);
    } else {
        status |= feed_back(c, m, preview, nodes, weights, w, torque);
    }
    if (!all_finite(U, torque)) {
        status |= STEWART_NONFINITE_TORQUE;
        copy(U, m->torque, torque);
    }
    memmove(m->in_flight[0], m->in_flight[1], (size_t)(U * (length - 1)) * sizeof(real));
    for (int i = 0; i < U; i++) {
        real t = torque[i], limit = c->torque_limit;
        real limited = t > limit ? limit : t < -limit ? -limit : t;
        if (limited != t)
            status |= STEWART_SATURATED;
        m->in_flight[length - 1][i] = limited;
    }
    copy(U, torque, m->torque);
    copy(X, measurement, m->measurement);
    copy(2, weights, m->weights);
    m->has_started = all_finite(X, m->state);
    m->silence -= m->silence > 0 && !waiting;
    for (int i = 0; i < STEWART_CAUSES; i++)
        m->counts[i] += m->counts[i] < INT_MAX ? (status >> i) & 1 : 0;
    return status;
}

void stewart_sent(const stewart_config *c, stewart_memory *m, const real *torque)
{
    stewart_acted(c, m, 1, 1, torque);
}

void stewart_acted(const stewart_config *c, stewart_memory *m, int ago, int number,
                   const real *torques)
{
    const int length = in_flight_length(c);
    for (int place = 1; number > 0 && place <= length; place++)
        if (ago <= place && ago > place - number)
            keep(torques + U * (place - ago), m->in_flight[length - place]);
}
