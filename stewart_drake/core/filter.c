#include "filter_attempt.h"
#include "short.h"

#define ITERATIONS 4 /* at most; one is enough when the parameters are roughly known */
/* Parts of the usual standard deviation at which a constant is known well enough */
#define KNOWN ((real)0.01)   /* for an F of second order, */
#define LEARNT ((real)0.3)   /* for a prediction over a few periods, */
#define DIRECTED ((real)0.1) /* for the direction in which a late torque moves the plate */
/* Factor t of noise.h for a torque far too early or late: tried from UNTIMELY up to MOST_UNTIMELY. After it
   t is at most GROWTH times the former one, which counts as ONCE or more. */
#define UNTIMELY 70
#define MOST_UNTIMELY 700
#define ONCE ((real)0.05)
#define GROWTH 30
/* Factors on `usual_std` by which parameters may have changed */
#define CHANGED ((real)1e-3)      /* the least */
#define MOST_CHANGED ((real)0.01) /* the largest for a single outlier */
#define MOST_AGREEING ((real)0.3) /* the largest if the last outlier agrees, or the prior is untested */
#define CHANGED_PER_OUTLIER ((real)3) /* more for each outlier that disagrees with the one before */
#define YOUNG 3          /* measurements after which a prior counts as tested */
#define MAX_DISTANCE 100 /* gates: an update is given up if its first iteration is beyond this */

int stewart_posterior_size(int n, int m)
{
    return n + n * n + m + (int)(sizeof(stewart_record) / sizeof(real));
}

stewart_posterior stewart_posterior_at(real *numbers, int n, int m)
{
    real *root = numbers + n, *outlier = root + n * n;
    return (stewart_posterior){numbers, root, outlier, (stewart_record *)(outlier + m)};
}

static int size_of(const stewart_filter *filter) { return X + filter->machine->estimated; }

static int is_known(const stewart_filter *filter, const real *root, real part)
{
    const int n = size_of(filter);
    for (int i = X; i < n; i++)
        if (!(filter->walk_std[i - X] > 0)
            && !(stewart_norm(n, root + n * i) <= part * filter->usual_std[i - X])) /* or NaN */
            return 0;
    return 1;
}

void stewart_attempt_noise(stewart_attempt *a)
{
    const stewart_filter *f = a->filter;
    const real t = a->prior->record->noise.timing;
    const real uncorrelated = is_known(f, a->prior->root, DIRECTED) ? STEWART_UNCORRELATED : 1;
    a->timing_factor = (1 - uncorrelated) * t;
    stewart_timing_effects(f->machine, a->period, a->end, a->after->mean + X, a->effects);
    for (int i = 0; i < X; i++) {
        real square = f->model_std[i] * f->model_std[i];
        for (int k = 0; k < a->changes; k++) {
            real *effect = a->effects + X * k + i;
            *effect *= f->timing_std;
            square += uncorrelated * t * *effect * *effect;
            a->timing_root[X * k + i] = REAL(sqrt)(a->timing_factor) * *effect;
        }
        a->end_std[i] = REAL(sqrt)(square);
    }
}

int stewart_attempt_finish(stewart_attempt *a, stewart_scratch scratch)
{
    const int n = a->n;
    const stewart_posterior *after = a->after;
    if (!a->values)
        stewart_copy(n * n, a->prior->root, after->root);
    real walk[STEWART_MAX_ESTIMATED];
    for (int i = 0; i < n - X; i++) {
        const real own = a->filter->walk_std[i], wander = a->filter->wander_std[i];
        walk[i] = REAL(sqrt)(own * own + after->record->noise.wander_in_use * wander * wander);
    }
    stewart_root_of_prediction(n, a->transition, a->end_std, walk, a->changes, a->timing_root, after->root,
                               scratch);
    stewart_copy(X, a->end, after->mean);
    stewart_copy(X, a->end + X, after->record->low);
    after->record->left_out = (real)a->left_out;
    return stewart_all_finite(n, after->mean) && stewart_all_finite(n * n, after->root);
}

/* An attempt with a measurement of the state at the period's end. */
typedef struct {
    stewart_measurement measurement;
    stewart_attempt *attempt;
    int fourth_order;
    real *states; /* (number, 12) */
} EndUpdate;

static int predict(void *context, const real *xi, real *end)
{
    EndUpdate *s = context;
    const stewart_schedule *schedule = &s->attempt->period->schedule;
    stewart_copy(X, s->attempt->after->record->low, s->attempt->end + X);
    stewart_predict(s->attempt->filter->machine, xi + X, schedule, xi, s->attempt->end + X, s->states);
    stewart_copy(X, s->states + X * (schedule->number - 1), end);
    return 1;
}

/* Compute H along the states of `predict`. */
static int linearize(void *context, const real *xi, real *H, stewart_scratch scratch)
{
    EndUpdate *s = context;
    return stewart_transitions(s->attempt->filter->machine, xi, &s->attempt->period->schedule,
                               s->fourth_order, s->states, 0, H, scratch);
}

/* Predict and linearise from the prior's mean, or take the result from `cache` if the mean is the same. */
static int begin(EndUpdate *s, const real *xi, real *end, stewart_scratch scratch)
{
    const int n = s->attempt->n;
    real *cache = s->attempt->cache, *mean = cache + 1, *last = mean + n, *H = last + 2 * X;
    int same = cache[0] == (real)s->fourth_order;
    for (int i = 0; i < n && same; i++)
        same = mean[i] == xi[i];
    if (same) {
        stewart_copy(2 * X, last, end);
        stewart_copy(X * n, H, s->measurement.H);
        return 1;
    }
    if (!predict(s, xi, end) || !linearize(s, xi, s->measurement.H, scratch))
        return 0;
    cache[0] = (real)s->fourth_order;
    stewart_copy(n, xi, mean);
    stewart_copy(2 * X, end, last);
    stewart_copy(X * n, s->measurement.H, H);
    return 1;
}

static int cache_size(int n) { return 1 + n + 2 * X + X * n; }

void stewart_attempt_learn(const stewart_attempt *a, int m, const real *innovations,
                           const real *variances, const real *H, const real *effects)
{
    const stewart_filter *f = a->filter;
    stewart_noise_learn(m, innovations, variances, a->n - X, H, f->wander_std,
                        f->learns_timing ? a->changes : 0, effects, f->forgetting, &a->after->record->noise);
}

static void learn(const EndUpdate *s, const real *innovations, const real *variances, stewart_scratch scratch)
{
    const stewart_measurement *at = &s->measurement;
    const int m = at->sensing->size, changes = s->attempt->changes;
    real *H = stewart_take(&scratch, m * at->n), *effects = stewart_take(&scratch, m * changes);
    stewart_whitened_derivative(at, H);
    stewart_apply_jacobian(at->sensing, at->J, changes, s->attempt->effects, effects);
    stewart_whiten(m, changes, at->C, effects);
    stewart_attempt_learn(s->attempt, m, innovations, variances, H, effects);
}

static int attempt_sample(stewart_attempt *a, stewart_scratch scratch)
{
    const stewart_filter *f = a->filter;
    const stewart_posterior *prior = a->prior;
    const int n = a->n, m = f->sensing->size, pieces = a->period->schedule.number;
    /* Corrections of known parameters are too small to need F to fourth order. */
    EndUpdate s = {.attempt = a, .fourth_order = !is_known(f, prior->root, KNOWN)};
    real *xi = a->after->mean, log_ratio;
    real *innovations = stewart_take(&scratch, m), *variances = stewart_take(&scratch, m);
    s.measurement = (stewart_measurement){f->sensing, a->values, n,  a->end,  a->end + X,
                                  NULL,       NULL,      NULL, &s, predict, linearize};
    s.measurement.C = stewart_take(&scratch, m * m);
    s.measurement.J = stewart_take(&scratch, m * X);
    s.states = stewart_take(&scratch, X * pieces);
    a->transition = s.measurement.H = stewart_take(&scratch, X * n);
    if (!begin(&s, xi, a->end, scratch))
        return 0;
    stewart_attempt_noise(a);
    if (!a->values)
        return stewart_attempt_finish(a, scratch);
    if (!stewart_innovation_root(f->sensing, a->end, a->changes, a->timing_root, a->end_std,
                                 s.measurement.C, scratch))
        return 0;
    const stewart_kalman update = {n, m, ITERATIONS, prior->mean, prior->root, f->lower, f->upper, &s,
                                   stewart_measurement_residuals, stewart_measurement_relinearize,
                                   a->after->record->low, a->max_distance, innovations, variances};
    if (!stewart_kalman_update(&update, xi, a->after->root, &a->distance, &log_ratio, scratch))
        return 0;
    a->log_likelihood = -(a->distance + log_ratio) / 2;
    for (int i = 0; i < m; i++)
        a->log_likelihood -= REAL(log)(s.measurement.C[(m + 1) * i]);
    if (!(a->distance <= f->gate)) /* or NaN */
        return 0;
    a->after->record->chi2 += a->distance;
    a->after->record->chi2_values += (real)m;
    learn(&s, innovations, variances, scratch);
    return stewart_attempt_finish(a, scratch);
}

/* Compute `after`; the attempt may be repeated with other values or another prior. Returns 0 for an
   outlier, or without a finite result. */
static int attempt(stewart_attempt *a, stewart_scratch scratch)
{
    a->left_out = a->gated_legs = 0;
    a->log_likelihood = -(real)INFINITY;
    stewart_copy(a->n, a->prior->mean, a->after->mean);
    *a->after->record = *a->prior->record;
    return a->filter->encoder_step ? a->filter->encoder_step->attempt(a, scratch) : attempt_sample(a, scratch);
}

int stewart_filter_start(const stewart_filter *filter, const real *values, const real *theta,
                         const real *near, real *estimate, stewart_scratch scratch)
{
    const stewart_sensing *sensing = filter->sensing;
    const int n = size_of(filter), p = n - X, m = sensing->size, offsets = filter->offsets;
    stewart_posterior e = stewart_posterior_at(estimate, n, m);
    real *root = stewart_take(&scratch, X * X), *known = stewart_take(&scratch, m);
    real *back = stewart_take(&scratch, LEGS * p), state[X];
    stewart_copy(m, values, known);
    for (int i = 0; i < m && offsets >= 0; i++)
        known[i] -= theta[offsets + i % LEGS];
    if (!sensing->start(sensing, known, near, state, root, scratch))
        return 0;
    if (offsets >= 0) { /* an error d of the offsets makes an error -J^-1 d of the pose */
        stewart_copy(LEGS * p, filter->prior_root + p * offsets, back);
        if (!filter->encoder_step->pose_changes(filter, state, back, scratch))
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
    stewart_fill(X, 0, e.record->low);
    stewart_fill(m, (real)NAN, e.outlier);
    e.record->outliers = e.record->age = e.record->left_out = e.record->disagreed = 0;
    return 1;
}

/* Start again from values (m) that did not fit. `change` is the standard deviation, in usual ones, by which
   parameters may have changed beyond their prior. The offsets of encoders do not change. */
static int start_again(const stewart_filter *filter, const real *values, const real *theta, const real *near,
                       real change, real *estimate, stewart_scratch scratch)
{
    const int n = size_of(filter);
    real added[STEWART_MAX_ESTIMATED];
    if (!stewart_filter_start(filter, values, theta, near, estimate, scratch))
        return 0;
    if (!(change > 0))
        return 1;
    for (int i = 0; i < n - X; i++) {
        const int is_offset = filter->offsets >= 0 && i >= filter->offsets && i < filter->offsets + LEGS;
        added[i] = is_offset ? 0 : change * filter->usual_std[i];
    }
    stewart_widen_root(n, added, estimate + n, scratch);
    return 1;
}

/* Compute `after` from `before`, which is `now` with `factor` times `std` (p) added to the deviations. */
static int attempt_changed(stewart_attempt *a, const stewart_posterior *now,
                           const stewart_posterior *before, const real *std, real factor,
                           stewart_scratch scratch)
{
    real added[STEWART_MAX_ESTIMATED];
    for (int i = 0; i < a->n - X; i++)
        added[i] = factor * std[i];
    stewart_copy(stewart_posterior_size(a->n, a->filter->sensing->size), now->mean, before->mean);
    stewart_widen_root(a->n, added, before->root, scratch);
    return attempt(a, scratch);
}

/* Compute `after` for a jump of parameters, from `now` with widened variances in `before`. Returns 0 if no
   jump explains the values. A large jump is not tried if only one leg does not fit: that is a fault. */
static int jump(stewart_attempt *a, const stewart_posterior *now, const stewart_posterior *before,
                stewart_scratch scratch)
{
    const real largest = a->gated_legs == 1 ? 1 : STEWART_MAX_JUMP;
    a->prior = before;
    for (real factor = 1; factor <= largest; factor *= 10)
        if (attempt_changed(a, now, before, a->filter->jump_std, factor, scratch) && !a->gated_legs)
            return 1;
    a->prior = now;
    return 0;
}

/* Replace the estimate by that of an attempt. */
static void accept(int n, int m, const stewart_posterior *found, stewart_posterior *now)
{
    stewart_copy(n, found->mean, now->mean);
    stewart_copy(n * n, found->root, now->root);
    stewart_fill(m, (real)NAN, now->outlier);
    *now->record = *found->record;
    now->record->outliers = now->record->age = now->record->disagreed = 0;
}

/* Return the largest log-density of an outlier over all factors on its covariance S. A cause must exceed it.
   With S scaled by distance / m, the maximum, distance and ln |S| change by m - distance and
   m ln(distance / m). */
static real without_cause(const stewart_attempt *a)
{
    const real m = (real)a->filter->sensing->size;
    if (!isfinite(a->log_likelihood))
        return -(real)INFINITY;
    return a->log_likelihood + (a->distance - m - m * REAL(log)(a->distance / m)) / 2;
}

/* Compute `after` for an outlier that has a cause, from `now` with more noise or widened variances in
   `before`: a torque came far too early or late, or parameters changed by the least factor that explains the
   values. The log-density with a late torque must exceed `without`. Returns 0 without a cause. */
static int explain(stewart_attempt *a, const stewart_posterior *now, const stewart_posterior *before,
                   real most, real without, stewart_scratch scratch)
{
    const stewart_filter *filter = a->filter;
    const int size = stewart_posterior_size(a->n, filter->sensing->size);
    real late = without, untimely = 0;
    int found = 0;
    a->prior = before;
    a->max_distance = MAX_DISTANCE * filter->gate;
    stewart_copy(size, now->mean, before->mean);
    for (real t = UNTIMELY; filter->learns_timing && t <= MOST_UNTIMELY; t *= 10) {
        if (now->record->noise.timing >= t)
            continue;
        before->record->noise.timing = t;
        if (attempt(a, scratch) && a->log_likelihood > late) {
            late = a->log_likelihood;
            untimely = t;
        }
    }
    /* The largest factor has the least distance: if the update is given up with it, it is with all. */
    const real *std = filter->usual_std;
    if (attempt_changed(a, now, before, std, most, scratch) || a->distance <= a->max_distance)
        for (real factor = CHANGED; !found && factor <= most; factor *= REAL(sqrt)(10))
            found = attempt_changed(a, now, before, std, factor, scratch);
    if (untimely > 0 && !(found && a->log_likelihood >= late)) {
        stewart_copy(size, now->mean, before->mean);
        before->record->noise.timing = untimely;
        found = attempt(a, scratch);
        a->after->record->noise = now->record->noise; /* one late torque does not make all of them late */
        const real once = now->record->noise.timing > ONCE ? now->record->noise.timing : ONCE;
        a->after->record->noise.timing = REAL(fmin)(GROWTH * once, untimely);
        a->after->record->noise.timing_information = 0; /* it holds near the former t only */
    }
    a->prior = now;
    a->max_distance = 0;
    return found;
}

void stewart_filter_advance(const stewart_filter *filter, const stewart_interval *period,
                            const real *values, const stewart_history *history, real *estimate,
                            stewart_scratch scratch)
{
    const int n = size_of(filter), m = filter->sensing->size, size = stewart_posterior_size(n, m);
    real *first = stewart_take(&scratch, size), *second = stewart_take(&scratch, size);
    stewart_posterior now = stewart_posterior_at(estimate, n, m);
    stewart_posterior after = stewart_posterior_at(first, n, m);
    stewart_posterior before = stewart_posterior_at(second, n, m);
    const real age = now.record->age + 1, *theta = now.mean + X;
    const real disagreed = now.record->disagreed, change = CHANGED_PER_OUTLIER * disagreed;
    real outliers = 1;
    stewart_attempt a = {.filter = filter, .n = n, .period = period, .prior = &now,
                         .values = values, .history = history, .after = &after};
    a.cache = stewart_take(&scratch, cache_size(n));
    a.cache[0] = (real)NAN;
    a.changes = stewart_changes(period);
    a.effects = stewart_take(&scratch, X * a.changes);
    a.timing_root = stewart_take(&scratch, X * a.changes);
    int fits = values && attempt(&a, scratch);
    const real without = without_cause(&a);
    if (values && filter->jump_std && (!fits || a.gated_legs)) {
        if (jump(&a, &now, &before, scratch)) {
            accept(n, m, &after, &now);
            return;
        }
        fits = fits && attempt(&a, scratch);
    }
    if (fits) {
        const int lost = now.record->age >= STEWART_PATIENCE && !is_known(filter, now.root, LEARNT);
        if (!lost || !stewart_filter_start(filter, values, theta, after.mean, estimate, scratch))
            accept(n, m, &after, &now);
        return;
    }
    a.prior = &before;
    stewart_copy(size, now.mean, second); /* a start keeps squares, values and noise */
    const int follows = values && now.record->outliers > 0; /* an outlier after an outlier */
    if (follows && start_again(filter, now.outlier, theta, now.mean, change, second, scratch)
        && attempt(&a, scratch))
        outliers += now.record->outliers;
    a.prior = &now;
    const real most = outliers > 1 || now.record->chi2_values <= YOUNG * (real)m ? MOST_AGREEING : MOST_CHANGED;
    if (values && !filter->encoder_step
        && explain(&a, &now, &before, most * (real)1.1, without, scratch)) {
        accept(n, m, &after, &now);
        return;
    }
    a.values = NULL;
    const int predicted = attempt(&a, scratch);
    if (values && (!predicted || outliers >= STEWART_PATIENCE)
        && start_again(filter, values, theta, predicted ? after.mean : now.mean, change, estimate,
                       scratch))
        return;
    if (predicted)
        accept(n, m, &after, &now);
    now.record->age = age;
    now.record->disagreed = disagreed + (follows && outliers == 1);
    if (values) {
        now.record->outliers = outliers;
        stewart_copy(m, values, now.outlier);
    }
}

int stewart_filter_scratch(const stewart_filter *filter, int torques)
{
    const stewart_encoder_step *encoder_step = filter->encoder_step;
    const int n = size_of(filter), p = n - X, m = filter->sensing->size;
    const int sample = m * (m + 3 + X) + m * (torques + 1) + X * (n + torques) + stewart_kalman_scratch(n, m);
    const int step = encoder_step ? encoder_step->scratch(filter, torques) : sample;
    const int within = step + stewart_transitions_scratch(p) + 2 * n * n + (X + 3 + torques) * n;
    return 2 * stewart_posterior_size(n, m) + cache_size(n) + 2 * X * (torques + 1) + within;
}
