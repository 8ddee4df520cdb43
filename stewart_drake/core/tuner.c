/* See tuner.h.

   Densities (45) relate each signal to its own mean over the window,

       rho(k) = |eps(k)| / mean |eps(i)|,  or with signs,  i = k - 30, ..., k,

   over the samples that are known; 1 where nothing but zeros is.

   Features of health relate timing, innovations, error and feedback to their usual size. A torque that
   arrives tau late leaves the rates off by -tau kappa at the next sample, kappa the change of the
   accelerations with which it arrives. With the innovation nu of the rates and its noise floor f,

       n = sum nu kappa / f^2,   d = sum kappa^2 / f^2,   E n^2 = tau^2 d^2 + d,

   hence over a window tau^2 = sum (n^2 - d) / sum d^2. One that comes early acts by the change at the
   end of the period instead. */

#include <string.h>

#include "tuner.h"
#include "short.h"

#define N STEWART_WINDOW
#define MODEL_ERROR ((real)2e-4) /* law/filter_settings.py */
#define HUGEST ((real)1e6)       /* bound of unbounded quantities, in their usual sizes */
#define SIGNED_LIMIT ((real)1e6)
#define LOWEST ((real)-6) /* logarithms among the features */
#define HIGHEST ((real)4)
#define LONGEST_DETECTABLE ((real)0.1) /* s */
#define MAX_FACTOR ((real)1.5)         /* of a weight per sample */
#define FALL ((real)0.35)              /* decades of w_Q / w_R per sample */
#define RISE ((real)0.15)
#define LEAST ((real)-4) /* ratios */
#define MOST ((real)2)

/* A row of the window: mean squares of the pose error, of feedback, of its change, of the innovation over its
   floor (SURPRISE) and over the tolerance (MISSED), NaN where unknown; n and d of late and of early torques;
   log10(w_Q / w_R); variance of the parameters over that of their prior; then the torque (6) that acted last. */
enum {
    ERROR, FEEDBACK, CHANGE, SURPRISE, MISSED, LATE, LATE_WEIGHT, EARLY, EARLY_WEIGHT, RATIO, DOUBT,
    ACTED, HEALTH_ROW = ACTED + U
};
enum { SURPRISE_PEAK = 11 }; /* feature of the rule */

static int columns_of(const stewart_tuner *t) { return t->health ? HEALTH_ROW : X + U; }

int stewart_tuner_memory(const stewart_tuner *t) { return 3 + N * columns_of(t); }

void stewart_tuner_start(const stewart_tuner *t, real *memory)
{
    stewart_fill(stewart_tuner_memory(t), (real)NAN, memory);
    stewart_copy(2, t->first, memory);
    memory[2] = 0;
}

static real decades(real x)
{
    return x > 0 ? clamped(LOWEST, REAL(log10)(x), HIGHEST) : LOWEST; /* NaN too */
}

static real mean_square(int n, const real *x)
{
    real sum = 0;
    int known = 0;
    for (int i = 0; i < n; i++)
        if (isfinite(x[i])) {
            sum += x[i] * x[i];
            known++;
        }
    return known ? sum / (real)known : (real)NAN;
}

/* ---- densities -------------------------------------------------------------------------------- */

/* Return (45) of a column. Signals are divided by the largest of the window, so that no sum overflows. */
static real density(const stewart_tuner *t, const real *window, int column)
{
    const int columns = X + U;
    const real newest = window[columns * (N - 1) + column];
    real largest = 0, total = 0;
    int known = 0;
    for (int i = 0; i < N; i++) {
        const real x = window[columns * i + column];
        if (!isfinite(x))
            continue;
        known++;
        if (REAL(fabs)(x) > largest)
            largest = REAL(fabs)(x);
    }
    if (!isfinite(newest) || !(largest > 0))
        return 1;
    for (int i = 0; i < N; i++) {
        const real x = window[columns * i + column] / largest;
        if (isfinite(x))
            total += t->is_signed ? x : REAL(fabs)(x);
    }
    const real last = newest / largest;
    if (!t->is_signed)
        return (real)known * (REAL(fabs)(last) / total);
    if (last == 0)
        return 0;
    return clamped(-SIGNED_LIMIT, (real)known * (last / total), SIGNED_LIMIT);
}

/* ---- health ----------------------------------------------------------------------------------- */

/* Sum of the known numbers of a column over rows `first` to `last`, counted from the newest. */
static real sum_of(const real *window, int column, int first, int last, int *known)
{
    real sum = 0;
    *known = 0;
    for (int i = first; i < last; i++) {
        const real x = window[HEALTH_ROW * (N - 1 - i) + column];
        if (!isnan(x)) {
            sum += x;
            ++*known;
        }
    }
    return sum;
}

static real rms(const real *window, int column, int first, int last)
{
    int known;
    const real sum = sum_of(window, column, first, last, &known);
    return known ? REAL(sqrt)((sum > 0 ? sum : 0) / (real)known) : 0;
}

static real newest(const real *window, int column)
{
    const real x = window[HEALTH_ROW * (N - 1) + column];
    return isnan(x) ? 0 : x;
}

/* Return tau in s over a number of rows, 0 if it is not significant; the column of d is after that of n. */
static real timing(const real *window, int column, int number)
{
    real squares = 0, excess = 0;
    for (int i = 0; i < number; i++) {
        const real *row = window + HEALTH_ROW * (N - 1 - i) + column;
        const real n = isnan(row[0]) ? 0 : row[0], d = isnan(row[1]) ? 0 : row[1];
        squares += d * d;
        excess += n * n - d;
    }
    return squares > 0 && excess > 0 ? REAL(sqrt)(excess / squares) : 0;
}

static void health(const stewart_tuner *t, const real *window, real *values)
{
    const real late_31 = timing(window, LATE, 31), late_10 = timing(window, LATE, 10);
    const real early = timing(window, EARLY, 31);
    int known;
    const real information = sum_of(window, LATE_WEIGHT, 0, N, &known);
    real detectable = 1 / REAL(sqrt)(information > (real)1e-30 ? information : (real)1e-30);
    detectable = detectable < LONGEST_DETECTABLE ? detectable : LONGEST_DETECTABLE;
    real latest = late_31 > late_10 ? late_31 : late_10, peak = 0, growth = 1, noise = 0;
    latest = latest > early ? latest : early;
    sum_of(window, FEEDBACK, 5, 15, &known);
    if (known)
        growth = (rms(window, FEEDBACK, 0, 5) + (real)1e-5) /
                 (rms(window, FEEDBACK, 5, 15) + (real)1e-5);
    for (int i = 0; i < N; i++) {
        const real x = window[HEALTH_ROW * i + SURPRISE];
        peak = x > peak ? x : peak;
    }
    for (int i = 0; i < X; i++)
        noise += t->noise[i] / t->motion[i] * (t->noise[i] / t->motion[i]) / X;
    const real found[STEWART_FEATURES] = {
        decades(1000 * late_31 + (real)0.05),
        decades(1000 * late_10 + (real)0.05),
        decades(1000 * REAL(hypot)(latest, 2 * detectable) + (real)0.05),
        decades(1000 * detectable),
        decades(rms(window, ERROR, 0, 10) + (real)1e-3),
        decades(rms(window, ERROR, 0, 31) + (real)1e-3),
        decades(rms(window, FEEDBACK, 0, 4) + (real)1e-4),
        decades(rms(window, FEEDBACK, 0, 20) + (real)1e-4),
        decades(rms(window, SURPRISE, 0, 3) + (real)0.1),
        decades(rms(window, SURPRISE, 0, 15) + (real)0.1),
        decades(rms(window, MISSED, 0, 10) + (real)1e-4),
        decades(REAL(sqrt)(peak) + (real)0.1),
        newest(window, RATIO),
        decades(REAL(sqrt)(noise) + (real)1e-4),
        t->delay,
        decades(REAL(sqrt)(newest(window, DOUBT)) + (real)1e-3),
        decades(rms(window, CHANGE, 0, 10) + (real)1e-4),
        decades(growth),
    };
    stewart_copy(STEWART_FEATURES, found, values);
}

/* ---- the decision ----------------------------------------------------------------------------- */

/* Raw weights: W2 sigmoid(W1 (x - mean) / scale + b1) + b2. */
static void network(const stewart_tuner *t, const real *values, real *weights)
{
    stewart_copy(2, t->b2, weights);
    for (int i = 0; i < t->hidden; i++) {
        real sum = t->b1[i];
        for (int j = 0; j < STEWART_FEATURES; j++)
            sum += t->W1[STEWART_FEATURES * i + j] * ((values[j] - t->input_mean[j]) / t->input_scale[j]);
        for (int k = 0; k < 2; k++)
            weights[k] += t->W2[t->hidden * k + i] / (1 + REAL(exp)(-sum));
    }
    for (int k = 0; t->logarithms && k < 2; k++)
        weights[k] = REAL(exp)(weights[k]);
}

static real ratio_of(const real *weights) { return REAL(log10)(weights[0] / weights[1]); }

void stewart_tuner_features(const stewart_tuner *t, const real *window, real *values)
{
    if (t->health)
        health(t, window, values);
    else
        for (int i = 0; i < STEWART_FEATURES; i++)
            values[i] = density(t, window, i);
}

int stewart_decide_by(const stewart_tuner *t, const real *values, const real *last, real *weights)
{
    real goal[2], ratio;
    int usable;
    if (t->policy == STEWART_FIXED_WEIGHTS) {
        stewart_copy(2, t->first, weights);
        return 0;
    }
    if (t->policy == STEWART_RULE) {
        real above = values[SURPRISE_PEAK] - t->knee;
        ratio = t->ratio - t->slope * (above > 0 ? above : 0);
        usable = isfinite(ratio);
        ratio = usable ? clamped(LEAST, ratio, MOST) : t->ratio;
    } else {
        network(t, values, goal);
        usable = stewart_all_finite(2, goal);
        for (int k = 0; k < 2; k++)
            goal[k] = usable ? clamped(t->bounds[k], goal[k], t->bounds[2 + k]) : t->first[k];
        if (t->policy == STEWART_PAPER_NETWORK) {
            for (int k = 0; k < 2; k++)
                weights[k] = clamped(last[k] / MAX_FACTOR, goal[k], last[k] * MAX_FACTOR);
            return !usable;
        }
        ratio = ratio_of(goal);
    }
    ratio = clamped(ratio_of(last) - FALL, ratio, ratio_of(last) + RISE);
    weights[0] = REAL(pow)(10, ratio / 2);
    weights[1] = REAL(pow)(10, -ratio / 2);
    return !usable;
}

int stewart_decide(const stewart_tuner *t, const real *memory, real *weights)
{
    const real *window = memory + 3, *row = window + columns_of(t) * (N - 1);
    real values[STEWART_FEATURES];
    int any = 0;
    for (int i = 0; i < columns_of(t); i++)
        any |= !isnan(row[i]);
    stewart_copy(2, t->first, weights);
    if (!any) /* nothing is known before the first sample */
        return 0;
    stewart_tuner_features(t, window, values);
    return stewart_decide_by(t, values, memory, weights);
}

/* ---- a row of the window ----------------------------------------------------------------------- */

/* Compute the innovation (12), and the changes (6) of the accelerations at the beginning and at the end of the
   last period. `acted` (6) is the torque that acted last before that period, then in it. Without a state the
   results are NaN, and zeros. */
static void innovate(const stewart_tuner_input *in, real *innovation, real *late, real *early,
                     real *acted, stewart_scratch scratch)
{
    const stewart_schedule *schedule = &in->schedule;
    real a[3][U];
    stewart_model model;
    stewart_fill(U, 0, late);
    stewart_fill(U, 0, early);
    if (!stewart_all_finite(X, in->state)) {
        stewart_fill(X, (real)NAN, innovation);
        stewart_fill(U, (real)NAN, acted);
        return;
    }
    real *states = stewart_take(&scratch, X * schedule->number);
    const real *last = schedule->torques + U * (schedule->number - 1);
    stewart_predict(in->machine, in->theta, schedule, in->state, NULL, states);
    stewart_set_model(in->machine, in->theta, &model);
    if (schedule->number > 1)
        stewart_copy(U, last - U, acted);
    else if (!stewart_all_finite(U, acted))
        stewart_copy(U, last, acted);
    const real *torques[3] = {acted, last, in->following};
    for (int k = 0; k < 3; k++)
        stewart_accelerate(&model, in->state, torques[k], a[k]);
    for (int i = 0; i < U; i++) {
        late[i] = a[1][i] - a[0][i];
        early[i] = a[2][i] - a[1][i];
    }
    for (int i = 0; i < X; i++)
        innovation[i] = in->measured[i] - states[X * (schedule->number - 1) + i];
    stewart_copy(U, last, acted);
}

/* x . y, 0 if that is not finite. */
static real known_product(const real *x, const real *y)
{
    const real sum = stewart_dot(6, x, y);
    return isfinite(sum) ? sum : 0;
}

/* Compute a row of health in place of the last one. */
static void health_row(const stewart_tuner *t, const stewart_tuner_input *in, const real *wanted,
                       const real *weights, real *row, stewart_scratch scratch)
{
    real innovation[X], over_floor[X], late[U], early[U], fed[2][U], change[U], error[6];
    real doubt[STEWART_MAX_ESTIMATED];
    const int p = in->machine->estimated;
    innovate(in, innovation, late, early, row + ACTED, scratch);
    for (int i = 0; i < X; i++) {
        const real noise = t->noise[i], model = MODEL_ERROR * t->motion[i];
        const real floor = REAL(sqrt)(2 * noise * noise + model * model);
        innovation[i] = clamped(-HUGEST * floor, innovation[i], HUGEST * floor);
        over_floor[i] = innovation[i] / floor;
        innovation[i] /= t->tolerance[i];
        if (i >= 6) {
            late[i - 6] = clamped(-HUGEST, late[i - 6] / floor, HUGEST);
            early[i - 6] = clamped(-HUGEST, early[i - 6] / floor, HUGEST);
        }
    }
    for (int i = 0; i < U; i++) {
        for (int k = 0; k < 2; k++)
            fed[k][i] = clamped(-HUGEST, (in->torque[k][i] - in->feedforward[k][i]) / t->torque, HUGEST);
        change[i] = fed[0][i] - fed[1][i];
        error[i] = clamped(-HUGEST, (in->measured[i] - wanted[i]) / t->tolerance[i], HUGEST);
    }
    for (int i = 0; t->doubts && i < p; i++)
        doubt[i] = in->std[i] / t->prior[i];
    row[ERROR] = mean_square(6, error);
    row[FEEDBACK] = mean_square(U, fed[0]);
    row[CHANGE] = mean_square(U, change);
    row[SURPRISE] = mean_square(X, over_floor);
    row[MISSED] = mean_square(X, innovation);
    row[LATE] = known_product(over_floor + 6, late);
    row[LATE_WEIGHT] = known_product(late, late);
    row[EARLY] = known_product(over_floor + 6, early);
    row[EARLY_WEIGHT] = known_product(early, early);
    row[RATIO] = ratio_of(weights);
    row[DOUBT] = t->doubts ? mean_square(p, doubt) : 0;
}

void stewart_tuner_observe(const stewart_tuner *t, real *memory, const stewart_tuner_input *input,
                           const real *wanted, const real *weights, int fell_back,
                           stewart_scratch scratch)
{
    const int columns = columns_of(t);
    real *window = memory + 3, *row = window + columns * (N - 1);
    memmove(window, window + columns, (size_t)(columns * (N - 1)) * sizeof(real));
    if (t->health) {
        health_row(t, input, wanted, weights, row, scratch);
    } else { /* [state less the reference; torque] */
        for (int i = 0; i < X; i++)
            row[i] = input->measured[i] - wanted[i];
        stewart_copy(U, input->torque[0], row + X);
    }
    stewart_copy(2, weights, memory);
    memory[2] += (real)fell_back;
}

int stewart_tuned_step_scratch(const stewart_law *law)
{
    return law->memory + stewart_step_scratch(law);
}

int stewart_tuned_step(const stewart_law *law, const stewart_tuner *t, real *memory,
                       real *tuner_memory, real *scratch_memory, stewart_sample *sample,
                       const real *wanted, real *torque)
{
    const stewart_layout *l = &law->layout;
    real *before = scratch_memory, theta[STEWART_MAX_ESTIMATED], std[STEWART_MAX_ESTIMATED];
    stewart_scratch scratch = {scratch_memory + law->memory};
    int fell_back = stewart_decide(t, tuner_memory, sample->weights);
    stewart_copy(law->memory, memory, before);
    int status = stewart_step(law, memory, scratch.next, sample, torque);
    if (status == STEWART_NOT_STARTED)
        return status;
    stewart_tuner_input input = {
        .machine = &law->machine,
        .state = before + l->state.at,
        .theta = before + l->parameters.at,
        .measured = memory + (law->num_values == X ? l->measurement.at : l->state.at),
        .torque = {memory + l->torque.at, before + l->torque.at},
        .feedforward = {memory + l->feedforward.at, before + l->feedforward.at},
        .std = std,
    };
    const int number = l->in_flight.rows;
    const real *in_flight = before + l->in_flight.at;
    if (law->observer->last_period) {
        law->observer->last_period(law, before + l->observer.at, number, in_flight, &input.schedule,
                                   &input.following, &scratch);
    } else {
        const stewart_interval period = stewart_last_periods(law, number, in_flight, 1, &scratch);
        input.schedule = period.schedule;
        input.following = period.following;
    }
    law->observer->parameters(law, memory + l->observer.at, theta, std);
    stewart_tuner_observe(t, tuner_memory, &input, wanted, sample->weights, fell_back, scratch);
    return status;
}
