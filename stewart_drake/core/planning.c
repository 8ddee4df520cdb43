/* Plans: see planning.h. */

#include "planning.h"
#include "reference.h"
#include "short.h"

#define ROUNDS 12 /* Newton steps */

/* Largest error at the end of a plan: rad, m over the reach, and both per s. In single precision a last step with
   the same J removes what is left of it, down to rounding. */
#ifdef STEWART_FLOAT
#define TOLERANCE ((real)1e-4)
#define LAST_STEPS 1
#else
#define TOLERANCE ((real)1e-10)
#define LAST_STEPS 0
#endif
/* Longest and shortest piece between two states of the dynamics, s. */
#define PIECE ((real)0.025)
#define SHORTEST ((real)1e-6)
/* Rounding of a time, over the length of a piece. A time between two pieces belongs to the later one. */
#define ROUNDING ((real)1e-5)

real stewart_margin(const real *geometry, const real *pose, real sign, const real *least)
{
    real measures[STEWART_NUM_MEASURES], margin = (real)HUGE_VAL;
    stewart_measures(geometry, pose, NULL, measures);
    measures[6] *= sign;
    for (int i = 0; i < STEWART_NUM_MEASURES; i++) {
        const real above = measures[i] - least[i];
        if (above < margin || isnan(above))
            margin = above;
    }
    return margin;
}

/* Return the longest reach of a leg, crank and rod in line, m. */
static real reach(const real *geometry)
{
    real longest = 0;
    for (int leg = 0; leg < 6; leg++)
        if (geometry[leg] + geometry[6 + leg] > longest)
            longest = geometry[leg] + geometry[6 + leg];
    return longest;
}

/* ---- pieces ------------------------------------------------------------------------------------- */

int stewart_path_row(int number, const real *pieces, real time, real *row)
{
    for (int k = 0; k < number; k++, pieces += STEWART_PIECE) {
        const real begin = pieces[0], end = pieces[1], *first = pieces + 2, *last = first + ROW;
        const real slack = ROUNDING * (end - begin);
        if (!(time < end - slack))
            continue;
        if (time >= begin - slack) {
            stewart_between(first, last, end - begin, (time - begin) / (end - begin), row);
            return 1;
        }
        for (int i = 0; i < 6; i++) {
            row[i] = first[i] + (time - begin) * first[6 + i];
            row[6 + i] = first[6 + i];
            row[12 + i] = 0;
        }
        return 1;
    }
    return 0;
}

static void end_row(const stewart_model *model, const real *state, const real *torque, real *row)
{
    stewart_copy(X, state, row);
    stewart_accelerate(model, state, torque, row + X);
}

static void add_piece(const stewart_model *model, real begin, real end, const real *states,
                      const real *torque, real *piece)
{
    piece[0] = begin;
    piece[1] = end;
    end_row(model, states, torque, piece + 2);
    end_row(model, states + X, torque, piece + 2 + ROW);
}

int stewart_predicted_pieces(const stewart_model *model, const stewart_schedule *schedule,
                             const real *states, real begin, real *pieces)
{
    int number = 0;
    real passed = 0;
    for (int k = 0; k < schedule->number; k++) {
        const real from = begin + passed, h = schedule->durations[k];
        passed += h;
        if (h > SHORTEST)
            add_piece(model, from, begin + passed, states + X * k, schedule->torques + U * k,
                      pieces + STEWART_PIECE * number++);
    }
    return number;
}

/* ---- plans --------------------------------------------------------------------------------------

   A plan is a sequence of n held torques that takes the plant from its state at the first time at which a
   torque can act exactly onto the reference: 12 equations in 6 n unknowns, n >= 2. Starting from the
   mean torques along a quintic, Newton steps of least norm (a Gauss-Newton shooting method)

       dT = J^+ (x_reference - x_n(T)),     J = [Phi_n ... Phi_2 Gamma_1, ..., Gamma_n],

   change it as little as possible, so that it stays smooth. The law follows the response to the plan. Each
   torque is held for one period, and in a plan of more than STEWART_MOST_HOLDS periods for several: it is
   followed just as well, and the time for planning does not grow further. */

typedef struct {
    const stewart_model *model;
    real sign;
    int number, pieces; /* holds, and equal pieces of each */
    real *edges;        /* (number + 1) s from the beginning */
    real *torques;      /* (number, 6) */
    real *states;       /* (number pieces + 1, 12) */
    real *J;            /* (6 number, 12), transposed */
} Plan;

static int holds_of(int periods)
{
    return periods < STEWART_MOST_HOLDS ? periods : STEWART_MOST_HOLDS;
}

/* Return the number of periods until hold k begins. */
static real sample_of(int periods, int k)
{
    const int holds = holds_of(periods);
    return k < holds ? REAL(rint)((real)k * ((real)periods / (real)holds)) : (real)periods;
}

static int pieces_per_hold(real period, int periods)
{
    real longest = 0;
    for (int k = 0; k < holds_of(periods); k++) {
        const real hold = period * (sample_of(periods, k + 1) - sample_of(periods, k));
        longest = hold > longest ? hold : longest;
    }
    return (int)REAL(ceil)(longest / PIECE);
}

int stewart_plan_pieces(real period, int periods)
{
    return holds_of(periods) * pieces_per_hold(period, periods);
}

int stewart_plan_scratch(real period, int periods)
{
    const int holds = holds_of(periods), states = stewart_plan_pieces(period, periods) + 1;
    return holds * (1 + U + U * X) + 1 + X * states + 9 * X * X + 6 * X * U + 6 * (X + 13 + X + U) + X;
}

void stewart_plan_times(real begin, real period, int periods, real times[3])
{
    const real end = begin + period * (real)periods;
    times[0] = end;
    for (int node = 0; node < 2; node++)
        times[1 + node] = end + period * GAUSS_NODES[node];
}

/* State (12) from which held torques follow the reference: with a change s of the torque over the hold, the
   rates are off by -dt/24 B s at its beginning (design.c). */
static int target(const stewart_model *model, real period, const real *rows, real *state,
                  stewart_scratch scratch)
{
    real *A = stewart_take(&scratch, X * X), *B = stewart_take(&scratch, X * U), torques[2][U], mean[U];
    for (int node = 0; node < 2; node++)
        stewart_required_torque(model, rows + ROW * (1 + node), torques[node]);
    for (int j = 0; j < U; j++)
        mean[j] = (torques[0][j] + torques[1][j]) / 2;
    stewart_copy(X, rows, state);
    if (!stewart_derivatives(NULL, model, rows, mean, A, B, NULL, scratch))
        return 0;
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < U; j++)
            state[6 + i] -=
                period / 24 * B[U * (6 + i) + j] * (SQRT_3 * (torques[1][j] - torques[0][j]));
    return 1;
}

/* Mean torques along the quintic from the start, without acceleration, to a row. */
static void guess(const real *start, const real *end, Plan *p)
{
    const real duration = p->edges[p->number];
    real from[ROW], row[ROW], torques[2][U];
    stewart_copy(X, start, from);
    stewart_fill(6, 0, from + X);
    for (int k = 0; k < p->number; k++) {
        for (int node = 0; node < 2; node++) {
            const real time = p->edges[k] + (p->edges[k + 1] - p->edges[k]) * GAUSS_NODES[node];
            stewart_between(from, end, duration, time / duration, row);
            stewart_required_torque(p->model, row, torques[node]);
        }
        for (int j = 0; j < U; j++)
            p->torques[U * k + j] = (torques[0][j] + torques[1][j]) / 2;
    }
}

static int is_inside(const Plan *p, const real *pose)
{
    static const real least[STEWART_NUM_MEASURES] = { /* dynamics/workspace.py */
        (real)0.01, (real)0.01, (real)0.01, (real)0.01, (real)0.01, (real)0.01, (real)1e-3,
        (real)-1.4835298641951802};
    return stewart_margin(p->model->plant.geometry, pose, p->sign, least) > 0;
}

/* States under the torques. Returns 0 where one of them is out of the workspace. */
static int respond(Plan *p)
{
    real low[X] = {0};
    for (int i = 0; i < p->number * p->pieces; i++) {
        const int k = i / p->pieces;
        real *state = p->states + X * (i + 1);
        stewart_copy(X, state - X, state);
        stewart_advance(p->model, p->torques + U * k,
                        (p->edges[k + 1] - p->edges[k]) / (real)p->pieces, 1, state, low);
    }
    for (int i = 0; i <= p->number * p->pieces; i++)
        if (!is_inside(p, p->states + X * i))
            return 0;
    return 1;
}

/* J, its rows divided by `size`, linearised half-way through each hold. */
static int differentiate(const real *size, Plan *p, stewart_scratch scratch)
{
    real *A = stewart_take(&scratch, X * X), *B = stewart_take(&scratch, X * U);
    real *Phi = stewart_take(&scratch, X * X), *Gamma = stewart_take(&scratch, X * U);
    real *after = stewart_take(&scratch, X * X), *product = stewart_take(&scratch, X * X);
    stewart_fill(X * X, 0, after);
    for (int i = 0; i < X; i++)
        after[(X + 1) * i] = 1;
    for (int k = p->number - 1; k >= 0; k--) {
        const real h = p->edges[k + 1] - p->edges[k], *start = p->states + X * k * p->pieces;
        const real *end = start + X * p->pieces;
        real middle[X];
        for (int i = 0; i < X; i++)
            middle[i] = (start[i] + end[i]) / 2;
        if (!stewart_derivatives(NULL, p->model, middle, p->torques + U * k, A, B, NULL, scratch))
            return 0;
        for (int i = 0; i < X * X; i++)
            A[i] *= h;
        for (int i = 0; i < X * U; i++)
            B[i] *= h;
        stewart_exponential(X, U, A, B, Phi, Gamma, scratch);
        stewart_multiply(X, X, U, after, Gamma, product);
        for (int i = 0; i < X; i++)
            for (int j = 0; j < U; j++)
                p->J[X * (U * k + j) + i] = product[U * i + j] / size[i % 6];
        stewart_multiply(X, X, X, after, Phi, product);
        stewart_copy(X * X, product, after);
    }
    return stewart_all_finite(X * U * p->number, p->J);
}

/* J' = Q [R; 0] of J' (m, n), m >= n, by Householder reflections: their vectors take the place of J', and
   `diagonal` is that of R. Returns 0 if J is singular. */
static int factorise(int m, int n, real *A, real *diagonal, real *beta)
{
    for (int k = 0; k < n; k++) {
        real square = 0;
        for (int i = k; i < m; i++)
            square += A[n * i + k] * A[n * i + k];
        diagonal[k] = A[n * k + k] > 0 ? -REAL(sqrt)(square) : REAL(sqrt)(square);
        if (!(square > 0))
            return 0;
        A[n * k + k] -= diagonal[k];
        beta[k] = -A[n * k + k] * diagonal[k];
        for (int j = k + 1; j < n; j++) {
            real sum = 0;
            for (int i = k; i < m; i++)
                sum += A[n * i + k] * A[n * i + j];
            for (int i = k; i < m; i++)
                A[n * i + j] -= sum / beta[k] * A[n * i + k];
        }
    }
    return 1;
}

/* x (m) += the shortest d with J d = b, d = Q [R'^-1 b; 0]; b is lost. */
static int add_least_norm(int m, int n, const real *A, const real *diagonal, const real *beta, real *b,
                          real *x, stewart_scratch scratch)
{
    real *d = stewart_take(&scratch, m);
    stewart_fill(m, 0, d);
    for (int k = 0; k < n; k++) {
        for (int i = 0; i < k; i++)
            b[k] -= A[n * i + k] * d[i];
        d[k] = b[k] / diagonal[k];
    }
    for (int k = n - 1; k >= 0; k--) {
        real sum = 0;
        for (int i = k; i < m; i++)
            sum += A[n * i + k] * d[i];
        for (int i = k; i < m; i++)
            d[i] -= sum / beta[k] * A[n * i + k];
    }
    for (int i = 0; i < m; i++)
        x[i] += d[i];
    return stewart_all_finite(m, d);
}

static int solve(const real *goal, Plan *p, stewart_scratch scratch)
{
    const real longest = reach(p->model->plant.geometry), size[6] = {1, 1, 1, longest, longest, longest};
    const real *last = p->states + X * p->number * p->pieces;
    const int m = U * p->number;
    real diagonal[X], beta[X];
    int left = LAST_STEPS;
    for (int round = 0; round < ROUNDS; round++) {
        real miss[X], most = 0;
        if (!respond(p))
            return 0;
        for (int i = 0; i < X; i++) {
            miss[i] = (goal[i] - last[i]) / size[i % 6];
            most = REAL(fabs)(miss[i]) > most ? REAL(fabs)(miss[i]) : most;
        }
        const int close = most <= TOLERANCE;
        if (close && left-- == 0)
            return stewart_all_finite(X, miss);
        if (!(close && round > 0) && !(differentiate(size, p, scratch) && factorise(m, X, p->J, diagonal, beta)))
            return 0;
        if (!add_least_norm(m, X, p->J, diagonal, beta, miss, p->torques, scratch))
            return 0;
    }
    return 0;
}

/* s from the beginning to a state. */
static real time_of(const Plan *p, int state)
{
    const int k = state / p->pieces, part = state % p->pieces;
    if (part == 0)
        return p->edges[k];
    return p->edges[k] + (p->edges[k + 1] - p->edges[k]) / (real)p->pieces * (real)part;
}

int stewart_plan_path(const stewart_model *model, real sign, const real *start, real begin,
                      real period, int periods, const real *rows, real *pieces, real *peak,
                      stewart_scratch scratch)
{
    Plan p = {model, sign, holds_of(periods), pieces_per_hold(period, periods), NULL, NULL, NULL, NULL};
    real goal[X];
    p.edges = stewart_take(&scratch, p.number + 1);
    p.torques = stewart_take(&scratch, U * p.number);
    p.states = stewart_take(&scratch, X * (p.number * p.pieces + 1));
    p.J = stewart_take(&scratch, X * U * p.number);
    for (int k = 0; k <= p.number; k++)
        p.edges[k] = period * sample_of(periods, k);
    stewart_copy(X, start, p.states);
    if (!target(model, period, rows, goal, scratch))
        return 0;
    guess(start, rows, &p);
    if (!solve(goal, &p, scratch))
        return 0;
    *peak = 0;
    for (int i = 0; i < U * p.number; i++)
        if (REAL(fabs)(p.torques[i]) > *peak)
            *peak = REAL(fabs)(p.torques[i]);
    for (int i = 0; i < p.number * p.pieces; i++)
        add_piece(model, begin + time_of(&p, i), begin + time_of(&p, i + 1), p.states + X * i,
                  p.torques + U * (i / p.pieces), pieces + STEWART_PIECE * i);
    return p.number * p.pieces;
}
