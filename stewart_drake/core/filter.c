/* See filter.h. */

#include "filter.h"

#define X STEWART_STATES
#define U STEWART_MOTORS
#define LEGS 6
#define MAX_ROWS 18  /* six legs at three nodes */
#define ITERATIONS 4 /* at the most; one does once the parameters are roughly known */
#define ENCODER_ITERATIONS 6
#define SMALL ((real)0.1)  /* a correction of so many standard deviations needs no second iteration */
#define KNOWN ((real)0.01) /* a parameter is known when its deviation is this share of the usual one */
#define LEARNT ((real)0.3) /* the same, for parameters that are good enough over a few periods */
#ifdef STEWART_FLOAT
#define ROUNDING ((real)1e-5) /* of a time, as a share of the period */
#else
#define ROUNDING 1e-9
#endif

int stewart_posterior_size(int n, int m)
{
    return n + n * n + m + 3;
}

stewart_posterior stewart_posterior_at(real *numbers, int n, int m)
{
    real *counts = numbers + n + n * n + m;
    return (stewart_posterior){numbers, numbers + n,  numbers + n + n * n,
                               counts,  counts + 1, counts + 2};
}

static int size_of(const stewart_filter *filter) { return X + filter->machine->estimated; }

static real length(int n, const real *x)
{
    real sum = 0;
    for (int i = 0; i < n; i++)
        sum += x[i] * x[i];
    return REAL(sqrt)(sum);
}

static int is_known(const stewart_filter *filter, const real *root, real share)
{
    const int n = size_of(filter);
    for (int i = X; i < n; i++)
        if (!(length(n, root + n * i) <= share * filter->usual_std[i - X])) /* or NaN */
            return 0;
    return 1;
}

void stewart_kicks(const stewart_machine *machine, const stewart_acted *period, const real *state,
                   const real *theta, real *squares)
{
    const stewart_acting *acting = &period->acting;
    stewart_belief belief;
    real before[6], after[6], left = 0;
    stewart_believe(machine, theta, &belief);
    stewart_fill(X, 0, squares);
    for (int k = 0; k < acting->number; k++)
        left += acting->durations[k];
    stewart_accelerate(&belief, state, acting->torques, before);
    for (int k = 0; k < acting->number; k++) {
        const int last = k + 1 == acting->number;
        stewart_accelerate(&belief, state, last ? period->following : acting->torques + U * (k + 1),
                           after);
        left = last ? 0 : left - acting->durations[k];
        for (int i = 0; i < 6; i++) {
            const real change = after[i] - before[i];
            squares[i] += left * change * left * change;
            squares[6 + i] += change * change;
            before[i] = after[i];
        }
    }
}

stewart_acting stewart_cut(const stewart_acting *acting, int n, const real *instants, real *torques,
                           real *durations, real *places)
{
    stewart_acting pieces = {0, torques, durations, 0};
    real total = 0, longest = 0, most = 0, passed = 0, end = 0;
    int next = 0;
    for (int k = 0; k < acting->number; k++) {
        total += acting->durations[k];
        most = acting->durations[k] > most ? acting->durations[k] : most;
    }
    const real apart = ROUNDING * total;
    for (int k = 0; k < acting->number; k++) {
        end += acting->durations[k];
        while (end - passed > apart) {
            int piece = pieces.number++;
            real until = next < n && instants[next] < end - apart ? instants[next] : end;
            stewart_copy(U, acting->torques + U * k, torques + U * piece);
            durations[piece] = until - passed;
            longest = durations[piece] > longest ? durations[piece] : longest;
            for (; next < n && instants[next] <= until + apart; next++)
                places[next] = (real)piece;
            passed = until;
        }
    }
    for (; next < n; next++) /* beyond the end by rounding */
        places[next] = (real)(pieces.number - 1);
    pieces.substeps = (int)REAL(ceil)((real)acting->substeps * longest / most - ROUNDING);
    return pieces;
}

/* One attempt at a period and a measurement. */
typedef struct {
    stewart_instant instant; /* of a measurement of the sample alone */
    const stewart_filter *filter;
    const stewart_acted *period;
    const real *values; /* or NULL */
    const stewart_history *history;
    const real *root;   /* of the prior */
    int exact;
    real end[X];        /* state at the end of the period */
    real drift[X];      /* standard deviation of the model's error there */
    real *states, *H;   /* (number, 12), (number, 12, n) of `stewart_transitions` */
    real *last;         /* (12, n) of those, at the end */
    /* of legs at several instants */
    stewart_acting coarse, fine; /* cut at nodes and at samples */
    real places[3];
    real *samples;      /* (N) pieces of `fine` */
    real *shown;        /* (N, 6) */
    real *seen;         /* (number, 12) states of `fine` */
    stewart_reading reading;
    int round, there, partly, number, kept[MAX_ROWS];
    const real *rows;   /* (number, n) whitened, of those kept */
} Step;

static void set_drift(Step *s, const real *theta)
{
    const stewart_filter *f = s->filter;
    real squares[X];
    stewart_kicks(f->machine, s->period, s->end, theta, squares);
    for (int i = 0; i < X; i++)
        s->drift[i] = REAL(sqrt)(f->model_std[i] * f->model_std[i]
                                 + f->timing_std * f->timing_std * squares[i]);
}

/* A measurement of the sample alone. */

static int predict(void *about, const real *xi, real *end)
{
    Step *s = about;
    const stewart_acting *acting = &s->period->acting;
    stewart_predict(s->filter->machine, xi + X, acting, xi, s->states);
    stewart_copy(X, s->states + X * (acting->number - 1), end);
    return 1;
}

/* H along the states of `predict`: those of the end are the last, where the instant has them. */
static int linearize(void *about, const real *xi, real *last, stewart_scratch scratch)
{
    Step *s = about;
    (void)last;
    return stewart_transitions_along(s->filter->machine, xi, &s->period->acting, s->exact, s->states,
                                     s->H, scratch);
}

/* Legs at several instants of a period.

   xi = [x_{k-1}; theta] is corrected by the residuals e_j (`stewart_beside`) at the M nodes s_j of the
   period. With F_j from xi to the state there and J = dh/dq,

       H_j = J(q_j) F_j[pose],   R_j = diag(var_j) + diag(s_j^2 J Q J'),

   Q the drift of the pose over a period, which counts as noise here as it does there. Each leg is
   judged by itself at each node: one with e^2 > 30 S, S = H P H' + R, is left out, and the step goes on
   with the rest; if that is less than half, the measurement is an outlier. */

static int along(Step *s, const real *xi, stewart_scratch scratch)
{
    const stewart_filter *f = s->filter;
    const stewart_encoders *encoders = f->encoders;
    const int n = size_of(f), last = s->coarse.number - 1;
    if (!stewart_transitions(f->machine, xi, &s->coarse, s->coarse.number <= 2, s->states, s->H,
                             scratch))
        return 0;
    stewart_copy(X, s->states + X * last, s->end);
    s->last = s->H + X * n * last;
    if (!s->values)
        return 1;
    stewart_predict(f->machine, xi + X, &s->fine, xi, s->seen);
    for (int k = 0; k < encoders->samples; k++) {
        real *angles = s->shown + LEGS * k;
        stewart_crank_angles(encoders->geometry, s->seen + X * (int)s->samples[k], angles);
        for (int leg = 0; leg < LEGS && f->offsets >= 0; leg++)
            angles[leg] += xi[X + f->offsets + leg];
    }
    return 1;
}

/* Causes for which legs were left out in part or wholly. */
static int left_out(const Step *s, const int *there)
{
    int causes = s->reading.missing ? STEWART_MISSING : 0;
    for (int leg = 0; leg < LEGS; leg++) {
        int gated = 0;
        for (int row = leg; row < LEGS * s->filter->encoders->nodes; row += LEGS)
            gated = gated || (there[row] && !s->kept[row]);
        const int stuck = gated && s->history->still[leg] > 0 && !s->reading.odd[leg];
        if (stuck)
            causes |= STEWART_FROZEN;
        if (s->reading.odd[leg] || (gated && !stuck))
            causes |= STEWART_REJECTED;
    }
    return causes;
}

static int rows_of_legs(void *model, const real *xi, real *e, real *H, stewart_scratch scratch)
{
    Step *s = model;
    const stewart_filter *f = s->filter;
    const stewart_encoders *encoders = f->encoders;
    const int n = size_of(f), rows = LEGS * encoders->nodes;
    real variance[MAX_ROWS], residual[MAX_ROWS], J[LEGS * 6];
    int there[MAX_ROWS], number = 0, kept = 0, given = 0;
    (void)xi;
    (void)scratch;
    stewart_beside(encoders, &s->reading, s->shown, residual);
    for (int node = 0; node < encoders->nodes; node++) {
        const int place = (int)s->places[node];
        const real *F = s->H + X * n * place, share = encoders->shares[node];
        stewart_crank_jacobian(encoders->geometry, s->states + X * place, J);
        stewart_multiply(LEGS, 6, n, J, F, H + LEGS * n * node);
        for (int leg = 0; leg < LEGS; leg++) {
            const int row = LEGS * node + leg;
            variance[row] = s->reading.variance[row];
            for (int i = 0; i < 6; i++) {
                const real moved = share * J[6 * leg + i] * s->drift[i];
                variance[row] += moved * moved;
            }
            if (f->offsets >= 0)
                H[n * row + X + f->offsets + leg] += 1;
        }
    }
    if (s->round++ == 0) {
        for (int row = 0; row < rows; row++) {
            real S = variance[row];
            for (int j = 0; j < n; j++) {
                real seen = 0;
                for (int i = 0; i < n; i++)
                    seen += H[n * row + i] * s->root[n * i + j];
                S += seen * seen;
            }
            there[row] = isfinite(variance[row]) != 0;
            s->kept[row] = there[row] && residual[row] * residual[row] <= STEWART_LEG_GATE * S;
            kept += s->kept[row];
            given += there[row];
        }
        if (!(2 * kept > given))
            return -1;
        s->partly = left_out(s, there);
    }
    for (int row = 0; row < rows; row++) {
        if (!s->kept[row])
            continue;
        const real std = REAL(sqrt)(variance[row]);
        e[number] = residual[row] / std;
        for (int j = 0; j < n; j++)
            H[n * number + j] = H[n * row + j] / std;
        number++;
    }
    s->rows = H;
    return s->number = number;
}

static int settle_legs(void *model, const real *xi, const real *better, stewart_scratch scratch)
{
    Step *s = model;
    const int n = size_of(s->filter);
    int small = 1;
    for (int row = 0; row < s->number; row++) {
        real change = 0;
        for (int j = 0; j < n; j++)
            change += s->rows[n * row + j] * (better[j] - xi[j]);
        small = small && REAL(fabs)(change) <= SMALL;
    }
    if (small)
        return 1;
    return along(s, better, scratch) ? 0 : -1;
}

/* Take the scratch memory of a step, and cut the period for legs. */
static stewart_scratch prepare(Step *s, stewart_scratch scratch)
{
    const stewart_filter *f = s->filter;
    const stewart_acting *acting = &s->period->acting;
    const stewart_encoders *encoders = f->encoders;
    const int n = size_of(f), m = f->sensing->size;
    int pieces = acting->number;
    if (encoders) {
        const int N = encoders->samples, M = encoders->nodes, fine = acting->number + N;
        real total = 0, *instants = stewart_take(&scratch, N);
        real *torques = stewart_take(&scratch, U * (acting->number + M));
        real *durations = stewart_take(&scratch, acting->number + M);
        for (int k = 0; k < acting->number; k++)
            total += acting->durations[k];
        for (int j = 0; j < M; j++)
            instants[j] = total * encoders->shares[j];
        s->coarse = stewart_cut(acting, M, instants, torques, durations, s->places);
        pieces = s->coarse.number;
        torques = stewart_take(&scratch, U * fine);
        durations = stewart_take(&scratch, fine);
        s->samples = stewart_take(&scratch, N);
        for (int k = 0; k < N; k++)
            instants[k] = total * (real)(k + 1) / (real)N;
        s->fine = stewart_cut(acting, N, instants, torques, durations, s->samples);
        s->shown = stewart_take(&scratch, LEGS * N);
        s->seen = stewart_take(&scratch, X * fine);
        s->reading.angles = stewart_take(&scratch, LEGS * N);
        s->reading.onto = stewart_take(&scratch, LEGS * M * M);
        s->reading.variance = stewart_take(&scratch, LEGS * M);
    } else {
        s->instant = (stewart_instant){f->sensing, s->values, n, s->end, NULL, NULL, NULL,
                                       s,          predict,   linearize};
        s->instant.C = stewart_take(&scratch, m * m);
        s->instant.J = stewart_take(&scratch, m * X);
    }
    s->states = stewart_take(&scratch, X * pieces);
    s->H = stewart_take(&scratch, X * n * pieces);
    s->last = s->instant.H = s->H + X * n * (pieces - 1);
    return scratch;
}

/* A period linearised about the prior. */
typedef struct {
    real end[X], drift[X];
    real *H; /* (12, n) at the end */
    int exists;
} Linear;

/* The prediction `after` a period, from a prior, by the model alone; returns 0 where it is not finite. */
static int go_on(int n, const stewart_posterior *prior, const Linear *linear,
                 stewart_posterior *after, stewart_scratch scratch)
{
    stewart_copy(n, prior->mean, after->mean);
    stewart_copy(X, linear->end, after->mean);
    stewart_copy(n * n, prior->root, after->root);
    stewart_root_of_prediction(n, linear->H, linear->drift, after->root, scratch);
    *after->partly = 0;
    return stewart_all_finite(n, after->mean) && stewart_all_finite(n * n, after->root);
}

/* Mean and root `after` a period and values; `linear`, unless it is NULL, is about the prior, and all
   that is found without values. Returns 0 for an outlier, or where there is no finite result. */
static int attempt(const stewart_filter *f, const stewart_acted *period,
                   const stewart_posterior *prior, const real *values,
                   const stewart_history *history, Linear *linear, stewart_posterior *after,
                   stewart_scratch scratch)
{
    const int n = size_of(f);
    const stewart_acting *acting = &period->acting;
    Step s = {.filter = f, .period = period, .values = values, .history = history,
              .root = prior->root, .exact = !is_known(f, prior->root, KNOWN)};
    real *xi = after->mean, distance = 0, spread;
    scratch = prepare(&s, scratch);
    stewart_copy(n, prior->mean, xi);
    /* Corrections of parameters that are known already are too small to need F to fourth order. */
    if (f->encoders ? !along(&s, xi, scratch)
                    : !predict(&s, xi, s.end) || !linearize(&s, xi, s.last, scratch))
        return 0;
    set_drift(&s, xi + X);
    if (linear) {
        stewart_copy(X, s.end, linear->end);
        stewart_copy(X, s.drift, linear->drift);
        stewart_copy(X * n, s.last, linear->H);
        linear->exists = 1;
    }
    if (!values)
        return 1;
    if (f->encoders)
        stewart_read(f->encoders, values, s.shown, history->last, history->still, &s.reading, scratch);
    else if (!stewart_seen_root(f->sensing, s.end, 0, NULL, s.drift, s.instant.C, scratch))
        return 0;
    stewart_kalman update = {n, f->encoders ? LEGS * f->encoders->nodes : f->sensing->size,
                             f->encoders ? ENCODER_ITERATIONS : ITERATIONS,
                             prior->mean, prior->root, f->lower, f->upper, &s,
                             f->encoders ? rows_of_legs : stewart_instant_rows,
                             f->encoders ? settle_legs : stewart_instant_settle};
    if (!stewart_kalman_update(&update, xi, after->root, &distance, &spread, scratch))
        return 0;
    if (!f->encoders && !(distance <= f->gate)) /* or NaN */
        return 0;
    if (f->encoders) {
        stewart_predict(f->machine, xi + X, acting, xi, s.seen);
        stewart_copy(X, s.seen + X * (acting->number - 1), s.end);
    }
    stewart_root_of_prediction(n, s.last, s.drift, after->root, scratch);
    stewart_copy(X, s.end, xi);
    *after->partly = (real)s.partly;
    return stewart_all_finite(n, xi) && stewart_all_finite(n * n, after->root);
}

int stewart_filter_start(const stewart_filter *filter, const real *values, const real *theta,
                         const real *near, real *estimate, stewart_scratch scratch)
{
    const stewart_sensing *sensing = filter->sensing;
    const int n = size_of(filter), p = n - X, m = sensing->size, offsets = filter->offsets;
    stewart_posterior e = stewart_posterior_at(estimate, n, m);
    real *root = stewart_take(&scratch, X * X), *known = stewart_take(&scratch, m);
    real *J = stewart_take(&scratch, LEGS * 6), *back = stewart_take(&scratch, LEGS * p), state[X];
    stewart_copy(m, values, known);
    for (int i = 0; i < m && offsets >= 0; i++)
        known[i] -= theta[offsets + i % LEGS];
    if (!sensing->start(sensing, known, near, state, root, scratch))
        return 0;
    if (offsets >= 0) { /* to first order dq = J^-1 (dy - do): as uncertain as the offsets make it */
        if (!stewart_crank_jacobian(filter->encoders->geometry, state, J))
            return 0;
        stewart_copy(LEGS * p, filter->prior_root + p * offsets, back);
        if (!stewart_solve(LEGS, p, J, back))
            return 0;
    }
    stewart_fill(n * n, 0, e.root);
    for (int i = 0; i < X; i++)
        stewart_copy(X, root + X * i, e.root + n * i);
    for (int i = 0; i < p; i++) {
        stewart_copy(p, filter->prior_root + p * i, e.root + n * (X + i) + X);
        for (int j = 0; j < p && offsets >= 0 && i < LEGS; j++)
            e.root[n * i + X + j] = -back[p * i + j];
        e.mean[X + i] = theta[i];
    }
    stewart_copy(X, state, e.mean);
    stewart_fill(m, (real)NAN, e.outlier);
    *e.outliers = *e.unseen = *e.partly = 0;
    return 1;
}

/* Take over mean and root of an attempt. */
static void accept(int n, int m, const stewart_posterior *found, stewart_posterior *now)
{
    stewart_copy(n, found->mean, now->mean);
    stewart_copy(n * n, found->root, now->root);
    stewart_fill(m, (real)NAN, now->outlier);
    *now->outliers = *now->unseen = 0;
    *now->partly = *found->partly;
}

void stewart_filter_advance(const stewart_filter *filter, const stewart_acted *period,
                            const real *values, const stewart_history *history, real *estimate,
                            stewart_scratch scratch)
{
    const int n = size_of(filter), m = filter->sensing->size, size = stewart_posterior_size(n, m);
    real *first = stewart_take(&scratch, size), *second = stewart_take(&scratch, size);
    stewart_posterior now = stewart_posterior_at(estimate, n, m);
    stewart_posterior after = stewart_posterior_at(first, n, m);
    stewart_posterior before = stewart_posterior_at(second, n, m);
    Linear linear = {.H = stewart_take(&scratch, X * n)};
    const real unseen = *now.unseen + 1, *theta = now.mean + X;
    real outliers = 1;
    if (attempt(filter, period, &now, values, history, &linear, &after, scratch) && values) {
        const int lost = *now.unseen >= STEWART_PATIENCE && !is_known(filter, now.root, LEARNT);
        if (!lost || !stewart_filter_start(filter, values, theta, after.mean, estimate, scratch))
            accept(n, m, &after, &now);
        return;
    }
    if (values && *now.outliers > 0
        && stewart_filter_start(filter, now.outlier, theta, now.mean, second, scratch)
        && attempt(filter, period, &before, values, history, NULL, &after, scratch))
        outliers += *now.outliers;
    const int alone = linear.exists && go_on(n, &now, &linear, &after, scratch);
    if (values && (!alone || outliers >= STEWART_PATIENCE)
        && stewart_filter_start(filter, values, theta, alone ? after.mean : now.mean, estimate,
                                scratch))
        return;
    if (alone)
        accept(n, m, &after, &now);
    *now.unseen = unseen;
    if (values) {
        *now.outliers = outliers;
        stewart_copy(m, values, now.outlier);
    }
}

int stewart_filter_scratch(const stewart_filter *filter, int torques)
{
    const stewart_encoders *encoders = filter->encoders;
    const int n = size_of(filter), p = n - X, m = filter->sensing->size;
    const int N = encoders ? encoders->samples : 0, M = encoders ? encoders->nodes : 0;
    const int coarse = torques + M, fine = torques + N;
    const int legs = (U + 1) * (coarse + fine) + 14 * N + X * fine + LEGS * M * (M + 1);
    const int step = (encoders ? legs : m * (m + 1 + X)) + X * (n + 1) * coarse;
    const int update = stewart_kalman_scratch(n, encoders ? LEGS * M : m);
    const int within = step + update + stewart_transitions_scratch(p) + 2 * n * n + n + N;
    const int start = X * X + m + LEGS * (6 + p) + (encoders ? stewart_encoder_scratch(encoders) : 0);
    return 2 * stewart_posterior_size(n, m) + X * n + (within > start ? within : start);
}
