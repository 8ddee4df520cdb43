/* The filter over state, parameters and the delay, xi = [x; theta; eta; eta_dot]: see delay.h.

   eta is the delay of a torque that arrives now,

       eta_{k+1} = eta_k + dt eta_dot_k + noise,   eta_dot_{k+1} = eta_dot_k + noise,

   and the torques that act between two samples follow from it (arrivals.h). dx/deta is a central
   difference of the whole prediction, over DIFFERENCE. If a torque changes at a sample, it is the mean of
   the derivatives of both sides. The rate delays an arrival at the time a within the period by
   a eta_dot. With dt/2 for a, dx/deta_dot = dt/2 dx/deta.

   The likelihood of a measurement, -1/2 (nu' S^-1 nu + ln |S|) with innovation nu and covariance S,
   is kept: the delay is found by comparing filters (delay_search.c). */

#include "delay.h"
#include "short.h"

#define MAX_ITERATIONS 6       /* of the update, while the delay is hardly known */
#define MAX_ITERATIONS_KNOWN 4 /* the same once it is known */
#define DELAYS_TRIED 15        /* first values of the delay for the iterations, while it is hardly known */
#define DIFFERENCE ((real)1e-3) /* s, step of the central difference by the delay */
#define KNOWN_PART ((real)0.01) /* part of its usual standard deviation at which a constant counts as known */
#define MEASURED_BEFORE_JUMP 10    /* measurements after which a misfit may be a jump of parameters */
#define TIMING_MEMORY 5         /* s over which the timing of single torques is estimated */
#define MAX_TIMING_STD ((real)0.1) /* periods, largest standard deviation of the timing */
#define STEP_STD ((real)0.02)   /* periods, standard deviation of a step of the delay after a misfit */
#define TIMING_MARGIN ((real)0.1) /* periods around a period from which timing moves a torque into it */
#define UNKNOWN_PHASE ((real)1 / 120) /* mean of (phi (1 - phi) / 2)^2, see stewart_period_late */
#define LARGEST_RATE ((real)0.5) /* s/s */
#define UNLIKELY ((real)-1e6) /* log-likelihood of a measurement that cannot be explained */

static int size_of(const stewart_delay *d) { return X + d->filter.machine->estimated + 2; }

int stewart_hypothesis_size(int p)
{
    const int n = X + p + 2;
    return STEWART_HYPOTHESIS + n + n * (n + 1) / 2;
}

void stewart_unpack_root(int n, const real *packed, real *L)
{
    for (int i = 0; i < n; packed += ++i) {
        stewart_copy(i + 1, packed, L + n * i);
        stewart_fill(n - i - 1, 0, L + n * i + i + 1);
    }
}

void stewart_hypothesis_set_root(int n, const real *L, stewart_hypothesis *hypothesis)
{
    real *packed = hypothesis->numbers + n;
    for (int i = 0; i < n; packed += ++i)
        stewart_copy(i + 1, L + n * i, packed);
}

real stewart_packed_std(int row, const real *packed)
{
    return stewart_norm(row + 1, packed + row * (row + 1) / 2);
}

real stewart_hypothesis_std(const stewart_hypothesis *hypothesis, int n)
{
    return stewart_packed_std(STEWART_ETA(n), hypothesis->numbers + n);
}

/* ---- one period ------------------------------------------------------------------------------- */

static stewart_arrivals arriving(const stewart_period *t, const real *xi)
{
    const int n = size_of(t->delay);
    stewart_arrivals view = t->view;
    view.eta = xi[STEWART_ETA(n)];
    view.rate = xi[STEWART_RATE(n)];
    return view;
}

/* Torque schedule of a period, and the states along it. */
typedef struct {
    int number;
    real *torques, *durations;
    real states[X * STEWART_MAX_SCHEDULE]; /* after each of them */
} Path;

static Path take_path(const stewart_period *t, stewart_scratch *scratch)
{
    const int most = t->num_in_flight + 3;
    Path path = {.torques = stewart_take(scratch, U * most)};
    path.durations = stewart_take(scratch, most);
    return path;
}

/* Compute the schedule between two times. Returns 0 for too many torques. */
static int schedule_between(const stewart_period *t, const real *xi, real begin, real end, Path *path)
{
    const stewart_arrivals view = arriving(t, xi);
    path->number = stewart_torque_schedule(&view, t->num_in_flight, t->in_flight, begin, end, t->newest,
                                           path->torques, path->durations);
    return path->number <= STEWART_MAX_SCHEDULE;
}

/* Compute the path of a period from xi, and the state at its end. Returns 0 for too many torques. */
static int predict(const stewart_period *t, const real *xi, Path *path, real *state)
{
    if (!schedule_between(t, xi, 0, t->delay->period, path))
        return 0;
    const stewart_schedule schedule = {path->number, path->torques, path->durations, 0};
    stewart_predict(t->delay->filter.machine, xi + X, &schedule, xi, NULL, path->states);
    stewart_copy(X, path->states + X * (path->number - 1), state);
    return 1;
}

int stewart_period_scratch(int p, int num_in_flight)
{
    return 2 * (U + 1) * (num_in_flight + 3) + X * (X + p) + X + p + 2 + stewart_transitions_scratch(p);
}

int stewart_delay_advance_scratch(int p, int m, int num_in_flight)
{
    const int n = X + p + 2, own = (2 * n + 2 * X + 1 + m) * n + (m + X + 1 + STEWART_MAX_SCHEDULE) * m
        + 2 * X + (U + 1) * (num_in_flight + 3); /* L, the model and `attempt` */
    const int tried = (X + 1) * n + (X + 1 + n) * m, judged = (n + m + STEWART_MAX_SCHEDULE) * m;
    const int update = stewart_kalman_scratch(n, m);
    const int more = (tried > update ? tried : update) + stewart_period_scratch(p, num_in_flight);
    const int predicted = (2 * n + STEWART_MAX_SCHEDULE) * n, most = more > judged ? more : judged;
    return own + 2 * n + (most > predicted ? most : predicted);
}

int stewart_period_end(const stewart_period *t, const real *xi, real *state,
                       stewart_scratch scratch)
{
    Path path = take_path(t, &scratch);
    return predict(t, xi, &path, state);
}

/* Compute H (12, n) along the path of a period from xi. */
static int linearize_along(const stewart_period *t, const real *xi, const Path *path,
                           int fourth_order, real *H, stewart_scratch scratch)
{
    const int n = size_of(t->delay), known = n - 2;
    const stewart_schedule schedule = {path->number, path->torques, path->durations, 0};
    real *by_known = stewart_take(&scratch, X * known), *moved = stewart_take(&scratch, n);
    real later[X], sooner[X];
    if (!stewart_transitions(t->delay->filter.machine, xi, &schedule, fourth_order, path->states, 0,
                             by_known, scratch))
        return 0;
    for (int i = 0; i < X; i++) {
        stewart_copy(known, by_known + known * i, H + n * i);
        H[n * i + STEWART_ETA(n)] = H[n * i + STEWART_RATE(n)] = 0;
    }
    if (!(xi[STEWART_ETA(n)] < STEWART_NO_ARRIVAL))
        return 1;
    stewart_copy(n, xi, moved);
    moved[STEWART_ETA(n)] = xi[STEWART_ETA(n)] + DIFFERENCE;
    if (!stewart_period_end(t, moved, later, scratch))
        return 0;
    moved[STEWART_ETA(n)] = xi[STEWART_ETA(n)] - DIFFERENCE;
    if (!stewart_period_end(t, moved, sooner, scratch))
        return 0;
    for (int i = 0; i < X; i++) {
        H[n * i + STEWART_ETA(n)] = (later[i] - sooner[i]) / (2 * DIFFERENCE);
        H[n * i + STEWART_RATE(n)] = t->delay->period / 2 * H[n * i + STEWART_ETA(n)];
    }
    return 1;
}

int stewart_period_at(const stewart_period *t, const real *xi, int fourth_order, real *state,
                      real *H, stewart_scratch scratch)
{
    Path path = take_path(t, &scratch);
    return predict(t, xi, &path, state) && linearize_along(t, xi, &path, fourth_order, H, scratch);
}

int stewart_period_misfit(const stewart_period *t, const real *xi, const real *y, const real *C,
                          real *cost, stewart_scratch scratch)
{
    const stewart_sensing *sensing = t->delay->filter.sensing;
    const int m = sensing->size;
    real *nu = stewart_take(&scratch, m), end[X];
    if (!stewart_period_end(t, xi, end, scratch))
        return 0;
    stewart_predict_measurement(sensing, end, nu);
    for (int i = 0; i < m; i++)
        nu[i] = y[i] - nu[i];
    stewart_whiten(m, 1, C, nu);
    for (int i = 0; i < m; i++)
        *cost += nu[i] * nu[i];
    return 1;
}

real stewart_normal_between(real x, real y)
{
    const int mirrored = x + y < 0; /* far below the mean both values would round to 1 */
    const real low = mirrored ? -y : x, high = mirrored ? -x : y;
    return (real)0.5 * (REAL(erfc)(low * SQRT_HALF) - REAL(erfc)(high * SQRT_HALF));
}

/* A change of torque dT that comes early adds B dT to the rates at the period's end, per second, and moves
   the pose by that for the rest of the period. A change at c with the timing error j acts in this period if
   c + j lies within it; the variance is that of j times the probability of this.

   The torques that were in flight at t = 0 changed at unknown times, phi dt after the samples. Mean
   torques of the periods, with a change dT per period, leave the rates off by B dT dt phi (1 - phi) / 2
   at the samples. For phi uniform in [0, 1] the mean square is UNKNOWN_PHASE (B dT dt)^2. */
int stewart_period_late(const stewart_period *t, const real *xi, const real *state, real std,
                        real *K, int *others, stewart_scratch scratch)
{
    const real dt = t->delay->period;
    const stewart_arrivals view = arriving(t, xi);
    real before[6], after[6], at = -TIMING_MARGIN * dt; /* time of a change of torque */
    Path path = take_path(t, &scratch);
    /* Arrival of the controller's first torque, see arrivals.h. */
    const real first_own = ((real)(t->newest + 1 - view.num_own) * dt + view.eta) * (1 + view.rate);
    stewart_model model;
    stewart_set_model(t->delay->filter.machine, xi + X, &model);
    *others = 0;
    if (!schedule_between(t, xi, at, dt - at, &path))
        return -1;
    stewart_accelerate(&model, state, path.torques, before);
    for (int k = 0; k + 1 < path.number; k++, K += X) {
        real left, late = REAL(sqrt)(UNKNOWN_PHASE) * dt; /* s: time to the end; timing's deviation */
        at += path.durations[k];
        left = clamped(0, dt - at, dt);
        if (view.num_own > 0 && at >= first_own - STEWART_TIME_TOLERANCE)
            late = std * REAL(sqrt)(REAL(fmax)(stewart_normal_between(-at / std, (dt - at) / std), 0));
        else
            ++*others;
        stewart_accelerate(&model, state, path.torques + U * (k + 1), after);
        for (int i = 0; i < 6; i++) {
            K[6 + i] = late * (after[i] - before[i]);
            K[i] = left * K[6 + i];
            before[i] = after[i];
        }
    }
    return path.number - 1;
}

/* ---- a measurement at its end ----------------------------------------------------------------- */

/* A period linearised at xi, and the measurement at its end. */
typedef struct {
    stewart_measurement measurement;
    const stewart_period *period;
    const real *mean;    /* (n) prior */
    Path path;           /* of the last prediction */
    int m, n, fourth_order;
    int rows, others;    /* of K: number of all rows, and of those before the controller's own */
    real *at_prior;      /* state and H about the prior, for all attempts */
    real K[X * STEWART_MAX_SCHEDULE];    /* (rows, 12), see stewart_period_late */
    real drift[X];       /* standard deviations of the model's other errors */
    real *late_effects;  /* (m, rows) J K', effect of K on the measurement */
    real *white, *nu;    /* (m, n) C^-1 J H, and (m) C^-1 nu, nu the innovation about the prior */
} Model;

static int predict_model(void *context, const real *xi, real *state)
{
    Model *a = context;
    return predict(a->period, xi, &a->path, state);
}

static int linearize_model(void *context, const real *xi, real *H, stewart_scratch scratch)
{
    Model *a = context;
    return linearize_along(a->period, xi, &a->path, a->fourth_order, H, scratch);
}

static int whitened_rows(void *context, const real *xi, real *e, real *H, stewart_scratch scratch)
{
    Model *a = context;
    stewart_measurement_residuals(&a->measurement, xi, e, H, scratch);
    stewart_copy(a->m * a->n, H, a->white);
    for (int i = 0; i < a->m; i++) {
        a->nu[i] = e[i];
        for (int j = 0; j < a->n; j++)
            a->nu[i] += H[a->n * i + j] * (xi[j] - a->mean[j]);
    }
    return a->m;
}

/* Return the variance of the timing, s^2. */
static real timing_of(const stewart_delay *d, const stewart_hypothesis *hypothesis)
{
    const real least = d->timing_std * d->timing_std;
    return hypothesis->timing > least ? hypothesis->timing : least;
}

/* Compute the noise of the model and of the torques' timing, of variance `used`, about xi and the state
   at the period's end. */
static int set_noise(Model *a, const real *xi, real used, stewart_scratch scratch)
{
    const stewart_delay *d = a->period->delay;
    a->rows = stewart_period_late(a->period, xi, a->measurement.state, REAL(sqrt)(used), a->K,
                                  &a->others, scratch);
    if (a->rows < 0)
        return 0;
    for (int i = 0; i < X; i++) {
        real square = d->filter.model_std[i] * d->filter.model_std[i];
        for (int k = 0; k < a->rows; k++)
            square += STEWART_UNCORRELATED * a->K[X * k + i] * a->K[X * k + i];
        a->drift[i] = REAL(sqrt)(square);
    }
    return 1;
}

/* xi <- the prior with the eta, out of DELAYS_TRIED values, that has the least nu' S^-1 nu; S leaves out the
   variance of the delay. The derivative by eta is 0 where a torque has not arrived yet, so iterations from
   there would never find its arrival. */
static int choose_delay(Model *a, const stewart_hypothesis *hypothesis, const real *L, real std, real *xi,
                        stewart_scratch scratch)
{
    const stewart_delay *d = a->period->delay;
    const int n = a->n, known = n - 2;
    const real reach = (real)2.5 * std, eta = a->mean[STEWART_ETA(n)];
    const real low = hypothesis->low > eta - reach ? hypothesis->low : eta - reach;
    const real high = hypothesis->high < eta + reach ? hypothesis->high : eta + reach;
    real *A = stewart_take(&scratch, known * X);
    real *trial = stewart_take(&scratch, n), least = (real)INFINITY;
    for (int i = 0; i < X; i++) /* rows of (H L)' */
        for (int j = 0; j < known; j++) {
            A[X * j + i] = 0;
            for (int k = j; k < known; k++)
                A[X * j + i] += a->measurement.H[n * i + k] * L[n * k + j];
        }
    /* J is that at the beginning of the period. */
    if (!stewart_innovation_root(d->filter.sensing, a->mean, known, A, d->filter.model_std,
                                 a->measurement.C, scratch))
        return 0;
    stewart_copy(n, a->mean, trial);
    for (int k = 0; k < DELAYS_TRIED; k++) {
        real cost = 0;
        trial[STEWART_ETA(n)] =
            k < DELAYS_TRIED - 1 ? low + (high - low) / (DELAYS_TRIED - 1) * (real)k : high;
        if (!stewart_period_misfit(a->period, trial, a->measurement.values, a->measurement.C, &cost,
                                   scratch))
            return 0;
        if (cost < least) {
            least = cost;
            xi[STEWART_ETA(n)] = trial[STEWART_ETA(n)];
        }
    }
    return 1;
}

/* Update a hypothesis' estimate of the variance s of single torques' timing.

   With S = S_0 + s M the log-likelihood has the slope and the information

       dL/ds = 1/2 (nu' S^-1 M S^-1 nu - tr S^-1 M),   I = 1/2 tr S^-1 M S^-1 M,

   so that s + (dL/ds) / I is the estimate of this measurement alone (Fisher scoring). One torque with
   nothing else uncertain has I = 1 / (2 s^2): a measurement counts as 2 s^2 I torques. The estimate is
   the mean over those. (Weighted by 1 / s^4 the first punctual torques would dominate for ever.)

   Whitened by C, S is 1 + W W' with W = C^-1 H L, and s M is B B' with B = C^-1 J K' of the own rows
   of K. With T = B' S^-1 B the traces are those of T and of T T. Returns 0 if S is not positive
   definite, 2 if this measurement alone gives more than twice the largest variance, else 1. */
static int update_timing(Model *a, const real *L, real used, stewart_hypothesis *after,
                         stewart_scratch scratch)
{
    const real dt = a->period->delay->period, most = MAX_TIMING_STD * dt * (MAX_TIMING_STD * dt);
    const int m = a->m, n = a->n, k = a->rows - a->others + 1;
    real *W = stewart_take(&scratch, m * n), *S = stewart_take(&scratch, m * m);
    real *B = stewart_take(&scratch, m * k), square = 0, trace = 0, pull = 0;
    stewart_multiply(m, n, n, a->white, L, W);
    stewart_multiply_by_transpose(m, n, m, W, W, S);
    for (int i = 0; i < m; i++)
        S[(m + 1) * i] += 1;
    if (!stewart_cholesky(m, S))
        return 0;
    stewart_fill(m * k, 0, B);
    for (int i = 0; i < m; i++)
        stewart_copy(k - 1, a->late_effects + a->rows * i + a->others, B + k * i);
    stewart_whiten(m, k, a->measurement.C, B);
    for (int i = 0; i < m; i++)
        B[k * i + k - 1] = a->nu[i];
    stewart_whiten(m, k, S, B); /* T = B' B, its last column B' S^-1 nu */
    for (int i = 0; i < k - 1; i++)
        for (int j = 0; j < k; j++) {
            real t = 0;
            for (int l = 0; l < m; l++)
                t += B[k * l + i] * B[k * l + j];
            if (j == k - 1)
                pull += t * t;
            else
                square += t * t;
            if (i == j)
                trace += t;
        }
    if (!(square > 0)) /* no torque has changed */
        return 1;
    const real alone = used * (1 + (pull - trace) / square); /* estimate by this measurement */
    const real torques = REAL(fmin)(after->torques, TIMING_MEMORY / dt);
    const real timing = (torques * after->timing + square * alone) / (torques + square);
    after->timing = timing < 0 ? 0 : timing < most ? timing : most;
    after->torques = torques + square;
    return 1 + (alone > 2 * most);
}

/* Whether the effect of a single torque can be separated from that of the delay. */
static int is_precise(const stewart_delay *d, const stewart_hypothesis *hypothesis, int n, real std)
{
    return std < d->period / 50 && hypothesis->numbers[STEWART_ETA(n)] < STEWART_NO_ARRIVAL;
}

/* Correct xi and the root of its covariance by a measurement; 0 where it does not fit. */
static int correct(Model *a, const stewart_hypothesis *hypothesis, const real *L, real std, real used, real *xi,
                   real *root, stewart_hypothesis *after, stewart_scratch scratch)
{
    const stewart_delay *d = a->period->delay;
    const int n = a->n, m = a->m;
    const int free_eta = stewart_norm(n, L + n * STEWART_ETA(n)) > 0;
    const int free_rate = stewart_norm(n, L + n * STEWART_RATE(n)) > 0;
    real *lower = stewart_take(&scratch, n), *upper = stewart_take(&scratch, n);
    real *C = a->measurement.C, distance, log_ratio;
    if (std > d->period / 10) {
        if (!choose_delay(a, hypothesis, L, std, xi, scratch)
            || !predict(a->period, xi, &a->path, a->measurement.state)
            || !linearize_along(a->period, xi, &a->path, a->fourth_order, a->measurement.H, scratch)
            || !set_noise(a, xi, used, scratch))
            return 0;
    }
    stewart_measurement_jacobian(d->filter.sensing, a->measurement.state, a->measurement.J);
    stewart_apply_jacobian(d->filter.sensing, a->measurement.J, a->rows, a->K, a->late_effects);
    if (!stewart_innovation_root(d->filter.sensing, a->measurement.state, a->rows, a->K, a->drift, C, scratch))
        return 0;
    stewart_copy(n - 2, d->filter.lower, lower);
    stewart_copy(n - 2, d->filter.upper, upper);
    lower[STEWART_ETA(n)] = free_eta ? hypothesis->low : -(real)INFINITY;
    upper[STEWART_ETA(n)] = free_eta ? hypothesis->high : (real)INFINITY;
    lower[STEWART_RATE(n)] = free_rate ? -LARGEST_RATE : -(real)INFINITY;
    upper[STEWART_RATE(n)] = free_rate ? LARGEST_RATE : (real)INFINITY;
    const stewart_kalman filter = {
        n, m, std > d->period / 100 ? MAX_ITERATIONS : MAX_ITERATIONS_KNOWN, a->mean, L, lower, upper, a,
        whitened_rows, stewart_measurement_relinearize, NULL, 0, NULL, NULL};
    if (!stewart_kalman_update(&filter, xi, root, &distance, &log_ratio, scratch))
        return 0;
    if (!(distance <= d->filter.gate)) /* or NaN */
        return 0;
    for (int i = 0; i < m; i++)
        log_ratio += 2 * REAL(log)(C[(m + 1) * i]);
    after->log_likelihood = -(distance + log_ratio) / 2;
    after->outliers = 0;
    after->chi2 += distance;
    after->chi2_values += (real)m;
    after->measurements += hypothesis->numbers[STEWART_ETA(n)] < STEWART_NO_ARRIVAL;
    if (is_precise(d, hypothesis, n, std)) {
        const int result = update_timing(a, L, used, after, scratch);
        if (!result)
            return 0;
        after->outliers = result == 2 ? hypothesis->outliers + 1 : 0;
    }
    return 1;
}

/* Compute `after`, one period after a hypothesis, with L (n, n) in place of its root. The variance of the
   timing is at least `least` (s^2); y may be NULL. Returns 0 if y does not fit. */
static int attempt(Model *a, const stewart_hypothesis *hypothesis, const real *L, const real *y, real least,
                   stewart_hypothesis *after, stewart_scratch scratch)
{
    const stewart_delay *d = a->period->delay;
    const int n = a->n;
    const real dt = d->period, std = stewart_norm(n, L + n * STEWART_ETA(n)), timing = timing_of(d, hypothesis);
    const real used = timing > least ? timing : least;
    real *xi = stewart_take(&scratch, n), *root = stewart_take(&scratch, n * n);
    real *eta = root + n * STEWART_ETA(n), *rate = root + n * STEWART_RATE(n);
    real walk[STEWART_MAX_ESTIMATED + 2] = {0};
    a->measurement.values = y;
    stewart_copy(n, hypothesis->numbers, xi);
    stewart_copy(X, a->at_prior, a->measurement.state);
    stewart_copy(X * n, a->at_prior + X, a->measurement.H);
    if (!set_noise(a, xi, used, scratch))
        return 0;
    for (int i = 0; i < STEWART_HYPOTHESIS; i++)
        ((real *)after)[i] = ((const real *)hypothesis)[i];
    after->log_likelihood = 0;
    after->fits = 1;
    if (!y)
        stewart_copy(n * n, L, root);
    else if (!correct(a, hypothesis, L, std, used, xi, root, after, scratch))
        return 0;
    /* eta is the mean over torques, whose timing bounds its accuracy: a growing variance of the timing adds
       to that of eta. */
    real added = 0;
    if (after->measurements > 0)
        added = REAL(fmax)(0, (timing_of(d, after) - timing) / after->measurements);
    stewart_copy(n - X - 2, d->filter.walk_std, walk);
    if (hypothesis->numbers[STEWART_ETA(n)] < STEWART_NO_ARRIVAL) {
        walk[STEWART_ETA(n) - X] = REAL(sqrt)(added + d->walk * d->walk * dt);
        walk[STEWART_RATE(n) - X] = d->rate_walk * REAL(sqrt)(dt);
    }
    /* The rate changes eta first, and H is the derivative by the eta before. */
    for (int j = 0; j < n; j++)
        eta[j] += dt * rate[j];
    for (int i = 0; i < X; i++)
        a->measurement.H[n * i + STEWART_RATE(n)] -= dt * a->measurement.H[n * i + STEWART_ETA(n)];
    stewart_root_of_prediction(n, a->measurement.H, a->drift, walk, a->rows, a->K, root, scratch);
    stewart_hypothesis_set_root(n, root, after);
    stewart_copy(X, a->measurement.state, after->numbers);
    stewart_copy(n - X, xi + X, after->numbers + X);
    after->numbers[STEWART_ETA(n)] += dt * xi[STEWART_RATE(n)];
    return stewart_all_finite(n + n * (n + 1) / 2, after->numbers);
}

/* L <- root of the covariance with std^2 added to the variance of eta, which may have changed. Only the
   last two rows of L change. */
static void widen_delay(int n, real std, real *L)
{
    real *eta = L + n * STEWART_ETA(n) + STEWART_ETA(n), *rate = L + n * STEWART_RATE(n) + STEWART_ETA(n);
    const real before = *eta, along = rate[0];
    *eta = REAL(sqrt)(before * before + std * std);
    if (!(*eta > 0))
        return;
    rate[0] = along * before / *eta;
    rate[1] = REAL(hypot)(rate[1], along * std / *eta);
}

/* Compute `after` with a measurement that a jump of parameters explains. Further outliers would show that
   the delay has jumped instead. Returns 0 if no jump explains it; L is restored. */
static int jumped(Model *a, const stewart_hypothesis *hypothesis, real *L, const real *y, stewart_hypothesis *after,
                  stewart_scratch scratch)
{
    const stewart_delay *d = a->period->delay;
    const int n = a->n, p = n - X - 2;
    real jump[STEWART_MAX_ESTIMATED + 2];
    for (real factor = 1; factor <= STEWART_MAX_JUMP; factor *= 10) {
        for (int i = 0; i < n - X; i++)
            jump[i] = i < p ? factor * d->filter.jump_std[i] : 0;
        stewart_widen_root(n, jump, L, scratch);
        const int fits = attempt(a, hypothesis, L, y, 0, after, scratch);
        stewart_unpack_root(n, hypothesis->numbers + n, L);
        if (fits) {
            after->outliers = hypothesis->outliers + 1;
            return 1;
        }
    }
    return 0;
}

void stewart_delay_advance(const stewart_period *t, const stewart_hypothesis *hypothesis, const real *y,
                           stewart_hypothesis *after, stewart_scratch scratch)
{
    const stewart_delay *d = t->delay;
    const int n = size_of(d), p = n - X - 2, m = d->filter.sensing->size;
    Model a = {.period = t, .mean = hypothesis->numbers, .m = m, .n = n};
    real *L = stewart_take(&scratch, n * n);
    a.path = take_path(t, &scratch);
    a.at_prior = stewart_take(&scratch, X + X * n);
    a.late_effects = stewart_take(&scratch, m * STEWART_MAX_SCHEDULE);
    a.white = stewart_take(&scratch, m * n);
    a.nu = stewart_take(&scratch, m);
    a.measurement = (stewart_measurement){.sensing = d->filter.sensing, .n = n, .context = &a,
                                  .predict = predict_model, .linearize = linearize_model};
    a.measurement.state = stewart_take(&scratch, X);
    a.measurement.H = stewart_take(&scratch, X * n);
    a.measurement.C = stewart_take(&scratch, m * m);
    a.measurement.J = stewart_take(&scratch, m * X);
    stewart_unpack_root(n, hypothesis->numbers + n, L);
    for (int i = 0; i < p; i++)
        if (!(d->filter.walk_std[i] > 0)
            && !(stewart_norm(n, L + n * (X + i)) <= KNOWN_PART * d->filter.usual_std[i])) /* or NaN */
            a.fourth_order = 1;
    const int exists =
        stewart_period_at(t, hypothesis->numbers, a.fourth_order, a.at_prior, a.at_prior + X, scratch);
    if (y && exists) {
        if (attempt(&a, hypothesis, L, y, 0, after, scratch))
            return;
        if (is_precise(d, hypothesis, n, stewart_hypothesis_std(hypothesis, n))) {
            const real most = MAX_TIMING_STD * d->period;
            widen_delay(n, STEP_STD * d->period, L);
            if (attempt(&a, hypothesis, L, y, most * most, after, scratch)) {
                after->outliers = hypothesis->outliers + 1; /* another one may be a jump of the delay */
                return;
            }
            stewart_unpack_root(n, hypothesis->numbers + n, L);
        }
        if (d->filter.jump_std && hypothesis->measurements >= MEASURED_BEFORE_JUMP && hypothesis->outliers == 0
            && jumped(&a, hypothesis, L, y, after, scratch))
            return;
    }
    if (!exists || !attempt(&a, hypothesis, L, NULL, 0, after, scratch)) /* the hypothesis has failed */
        stewart_copy(stewart_hypothesis_size(p), (const real *)hypothesis, (real *)after);
    if (y) {
        after->fits = 0;
        after->outliers = hypothesis->outliers + 1;
        after->log_likelihood = UNLIKELY;
    }
}
