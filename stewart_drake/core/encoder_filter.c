/* The filter for encoders, which are read at several times of a period: see filter_attempt.h. */

#include "encoders.h"
#include "filter_attempt.h"
#include "short.h"

#define MAX_ROWS 18 /* six legs at three nodes */
#define MAX_ITERATIONS 6
#define SMALL ((real)0.1) /* standard deviations; a smaller correction ends the iterations */
#ifdef STEWART_FLOAT
#define ROUNDING ((real)1e-5) /* of a time, periods */
#else
#define ROUNDING 1e-9
#endif

/* Cut a schedule (number) at times (n), ascending, in s. There is place for number + n torques and
   durations; `places` (n) are the pieces that end at the times. */
static stewart_schedule cut(const stewart_schedule *schedule, int n, const real *times,
                            real *torques, real *durations, real *places)
{
    stewart_schedule pieces = {0, torques, durations, 0};
    real total = 0, longest = 0, most = 0, passed = 0, end = 0;
    int next = 0;
    for (int k = 0; k < schedule->number; k++) {
        total += schedule->durations[k];
        most = schedule->durations[k] > most ? schedule->durations[k] : most;
    }
    const real apart = ROUNDING * total;
    for (int k = 0; k < schedule->number; k++) {
        end += schedule->durations[k];
        while (end - passed > apart) {
            int piece = pieces.number++;
            real until = next < n && times[next] < end - apart ? times[next] : end;
            stewart_copy(U, schedule->torques + U * k, torques + U * piece);
            durations[piece] = until - passed;
            longest = durations[piece] > longest ? durations[piece] : longest;
            for (; next < n && times[next] <= until + apart; next++)
                places[next] = (real)piece;
            passed = until;
        }
    }
    for (; next < n; next++) /* beyond the end by rounding */
        places[next] = (real)(pieces.number - 1);
    pieces.substeps = (int)REAL(ceil)((real)schedule->substeps * longest / most - ROUNDING);
    return pieces;
}

/* Update by the encoders of a period.

   xi = [x_{k-1}; theta] is corrected by the residuals e_j (`stewart_node_residuals`) at the M nodes s_j of the
   period. With F_j from xi to the state present and J = dh/dq,

       H_j = J(q_j) F_j[pose],   R_j = diag(var_j) + diag(s_j^2 J Q J'),

   with Q the covariance of `end_std`. A change of torque at t_c that changes the acceleration by a_c, and
   has the timing error sigma, adds k_c k_c' to the covariance,

       k_c = sigma (s_j - t_c) J(q_j) a_c   at nodes after it.

   Each leg is tested at each node: a value with e^2 > 30 S, S = H P H' + R, is left out. If more than half
   of the values are left out, the measurement is an outlier. */

typedef struct {
    stewart_attempt *attempt;
    const stewart_encoders *encoders;
    real *states, *H;            /* (number, 12), (number, 12, n) of `stewart_transitions` */
    stewart_schedule coarse, fine; /* cut at nodes and at samples */
    real places[3];
    real *samples;    /* (N) pieces of `fine` */
    real *predicted;  /* (N, 6) predicted angles, rad, with the estimated offsets */
    real *fine_states; /* (number, 12) states of `fine` */
    stewart_reading reading;
    int round;           /* number of calls of `residuals_of_encoders`: values are tested in round 0 */
    int number;          /* of the rows used */
    int is_used[MAX_ROWS]; /* whether each row of leg and node is used */
    real *since;      /* (M, changes) s from a change of torque to a node, 0 before it */
    real *effects;    /* (number, changes) effects of the torques' timing, whitened, of the rows used */
    real *C;          /* (number, number) Cholesky factor of their covariance */
    const real *rows; /* (number, n) H, whitened, of the rows used */
} EncoderUpdate;

/* Predict states, transitions and angles from xi. Returns 0 where they do not exist. */
static int predict_readings(EncoderUpdate *s, const real *xi, stewart_scratch scratch)
{
    stewart_attempt *a = s->attempt;
    const stewart_filter *f = a->filter;
    const stewart_encoders *encoders = s->encoders;
    const int n = a->n, last = s->coarse.number - 1;
    stewart_copy(X, a->after->record->low, a->end + X);
    stewart_predict(f->machine, xi + X, &s->coarse, xi, a->end + X, s->states);
    /* Fourth order where the pieces are long: one or two in the period. */
    if (!stewart_transitions(f->machine, xi, &s->coarse, s->coarse.number <= 2, s->states, X * n, s->H,
                             scratch))
        return 0;
    stewart_copy(X, s->states + X * last, a->end);
    a->transition = s->H + X * n * last;
    if (!a->values)
        return 1;
    stewart_predict(f->machine, xi + X, &s->fine, xi, NULL, s->fine_states);
    for (int k = 0; k < encoders->samples; k++) {
        real *angles = s->predicted + LEGS * k;
        stewart_crank_angles(encoders->geometry, s->fine_states + X * (int)s->samples[k], angles);
        for (int leg = 0; leg < LEGS && f->offsets >= 0; leg++)
            angles[leg] += xi[X + f->offsets + leg];
    }
    return 1;
}

/* Return the causes of left-out values as bits of a `fault`, and count in `gated_legs` the legs beyond the
   gate. `present` (6 M) are the rows that have a value, before the test.

       a sample was not read                              missing
       samples of a leg are outliers within the period    rejected
       else: a leg is beyond the gate at a node
           and its code is constant                       frozen: the encoder does not follow the motion
           and its code changes                           rejected

   Only the last two count as gated: they may be a jump of the parameters, which filter.c tries. Outliers within
   a period cannot. */
static int causes_of(const EncoderUpdate *s, const int *present)
{
    int causes = s->reading.missing ? STEWART_MISSING : 0;
    s->attempt->gated_legs = 0;
    for (int leg = 0; leg < LEGS; leg++) {
        int gated = 0;
        for (int row = leg; row < LEGS * s->encoders->nodes; row += LEGS)
            gated = gated || (present[row] && !s->is_used[row]);
        if (s->reading.has_outliers[leg]) {
            causes |= STEWART_REJECTED;
        } else if (gated) {
            s->attempt->gated_legs++;
            causes |= s->attempt->history->unchanged[leg] > 0 ? STEWART_FROZEN : STEWART_REJECTED;
        }
    }
    return causes;
}

/* Residuals e of the rows used, and their H, whitened. Returns their number, or -1 for an outlier. */
static int residuals_of_encoders(void *context, const real *xi, real *e, real *H, stewart_scratch scratch)
{
    EncoderUpdate *s = context;
    stewart_attempt *a = s->attempt;
    const stewart_encoders *encoders = s->encoders;
    const int n = a->n, rows = LEGS * encoders->nodes, offsets = a->filter->offsets;
    real variance[MAX_ROWS], residual[MAX_ROWS], J[LEGS * 6];
    int present[MAX_ROWS], number = 0, used = 0, given = 0;
    (void)xi;
    (void)scratch;
    stewart_node_residuals(encoders, &s->reading, s->predicted, residual);
    for (int node = 0; node < encoders->nodes; node++) {
        const int place = (int)s->places[node];
        const real *F = s->H + X * n * place, time = encoders->node_times[node];
        stewart_crank_jacobian(encoders->geometry, s->states + X * place, J);
        stewart_multiply(LEGS, 6, n, J, F, H + LEGS * n * node);
        for (int leg = 0; leg < LEGS; leg++) {
            const int row = LEGS * node + leg;
            variance[row] = s->reading.variance[row];
            for (int i = 0; i < 6; i++) {
                const real moved = time * J[6 * leg + i] * a->end_std[i];
                variance[row] += moved * moved;
            }
            for (int c = 0; c < a->changes; c++)
                s->effects[a->changes * row + c] = s->since[a->changes * node + c]
                                                 * stewart_dot(6, J + 6 * leg, a->effects + X * c + 6);
            if (offsets >= 0)
                H[n * row + X + offsets + leg] += 1;
        }
    }
    if (s->round++ == 0) {
        for (int row = 0; row < rows; row++) {
            const real *effects = s->effects + a->changes * row;
            real S = variance[row] + a->timing_factor * stewart_dot(a->changes, effects, effects);
            for (int j = 0; j < n; j++) {
                real part = 0;
                for (int i = 0; i < n; i++)
                    part += H[n * row + i] * a->prior->root[n * i + j];
                S += part * part;
            }
            present[row] = isfinite(variance[row]) != 0;
            s->is_used[row] = present[row] && residual[row] * residual[row] <= STEWART_LEG_GATE * S;
            used += s->is_used[row];
            given += present[row];
        }
        if (!(2 * used > given))
            return -1;
        a->left_out = causes_of(s, present);
    }
    for (int row = 0; row < rows; row++) {
        if (!s->is_used[row])
            continue;
        e[number] = residual[row];
        variance[number] = variance[row];
        stewart_copy(n, H + n * row, H + n * number);
        stewart_copy(a->changes, s->effects + a->changes * row, s->effects + a->changes * number);
        number++;
    }
    stewart_multiply_by_transpose(number, a->changes, number, s->effects, s->effects, s->C);
    for (int i = 0; i < number; i++) {
        for (int j = 0; j <= i; j++)
            s->C[number * i + j] *= a->timing_factor;
        s->C[(number + 1) * i] += variance[i];
    }
    if (!stewart_cholesky(number, s->C))
        return -1;
    stewart_whiten(number, 1, s->C, e);
    stewart_whiten(number, n, s->C, H);
    stewart_whiten(number, a->changes, s->C, s->effects);
    s->rows = H;
    return s->number = number;
}

/* Predict from an updated xi. Returns 1 if the change is small, 0 to go on, -1 without a prediction. */
static int relinearize(void *context, const real *change, const real *updated, stewart_scratch scratch)
{
    EncoderUpdate *s = context;
    const int n = s->attempt->n;
    int small = 1;
    for (int row = 0; row < s->number; row++) {
        const real moved = stewart_dot(n, s->rows + n * row, change);
        small = small && REAL(fabs)(moved) <= SMALL;
    }
    if (small)
        return 1;
    return predict_readings(s, updated, scratch) ? 0 : -1;
}

/* Take the scratch memory of an attempt, and cut the period. */
static stewart_scratch prepare(EncoderUpdate *s, stewart_scratch scratch)
{
    const stewart_schedule *schedule = &s->attempt->period->schedule;
    const stewart_encoders *encoders = s->encoders;
    const int n = s->attempt->n, N = encoders->samples, M = encoders->nodes;
    const int fine = schedule->number + N, changes = s->attempt->changes;
    real total = 0, *times = stewart_take(&scratch, N);
    real *torques = stewart_take(&scratch, U * (schedule->number + M));
    real *durations = stewart_take(&scratch, schedule->number + M);
    for (int k = 0; k < schedule->number; k++)
        total += schedule->durations[k];
    for (int j = 0; j < M; j++)
        times[j] = total * encoders->node_times[j];
    s->coarse = cut(schedule, M, times, torques, durations, s->places);
    torques = stewart_take(&scratch, U * fine);
    durations = stewart_take(&scratch, fine);
    s->samples = stewart_take(&scratch, N);
    for (int k = 0; k < N; k++)
        times[k] = total * (real)(k + 1) / (real)N;
    s->fine = cut(schedule, N, times, torques, durations, s->samples);
    s->predicted = stewart_take(&scratch, LEGS * N);
    s->fine_states = stewart_take(&scratch, X * fine);
    s->reading.angles = stewart_take(&scratch, LEGS * N);
    s->reading.fit = stewart_take(&scratch, LEGS * M * M);
    s->reading.variance = stewart_take(&scratch, LEGS * M);
    s->since = stewart_take(&scratch, M * changes);
    for (int j = 0; j < M; j++) {
        real since = total * encoders->node_times[j];
        for (int c = 0; c < changes; c++) {
            s->since[changes * j + c] = since > 0 ? since : 0;
            since -= c + 1 < changes ? schedule->durations[c] : 0;
        }
    }
    s->effects = stewart_take(&scratch, LEGS * M * changes);
    s->C = stewart_take(&scratch, LEGS * M * LEGS * M);
    s->states = stewart_take(&scratch, X * s->coarse.number);
    s->H = stewart_take(&scratch, X * n * s->coarse.number);
    return scratch;
}

static int attempt(stewart_attempt *a, stewart_scratch scratch)
{
    const stewart_filter *f = a->filter;
    const stewart_schedule *schedule = &a->period->schedule;
    const stewart_history *history = a->history;
    EncoderUpdate s = {.attempt = a, .encoders = f->sensing->kind};
    real *xi = a->after->mean, distance = 0, log_ratio;
    real innovations[MAX_ROWS], variances[MAX_ROWS];
    scratch = prepare(&s, scratch);
    if (!predict_readings(&s, xi, scratch))
        return 0;
    stewart_attempt_noise(a);
    if (!a->values)
        return stewart_attempt_finish(a, scratch);
    stewart_read(s.encoders, a->values, s.predicted, history->last, history->unchanged, &s.reading, scratch);
    const stewart_kalman update = {a->n,     LEGS * s.encoders->nodes, MAX_ITERATIONS, a->prior->mean,
                                   a->prior->root, f->lower, f->upper, &s, residuals_of_encoders, relinearize,
                                   a->after->record->low, 0, innovations, variances};
    if (!stewart_kalman_update(&update, xi, a->after->root, &distance, &log_ratio, scratch))
        return 0;
    a->after->record->chi2 += distance;
    a->after->record->chi2_values += (real)s.number;
    stewart_attempt_learn(a, s.number, innovations, variances, s.rows, s.effects);
    stewart_copy(X, a->after->record->low, a->end + X);
    stewart_predict(f->machine, xi + X, schedule, xi, a->end + X, s.fine_states);
    stewart_copy(X, s.fine_states + X * (schedule->number - 1), a->end);
    return stewart_attempt_finish(a, scratch);
}

static int attempt_scratch(const stewart_filter *filter, int torques)
{
    const stewart_encoders *encoders = filter->sensing->kind;
    const int N = encoders->samples, M = encoders->nodes, n = X + filter->machine->estimated;
    const int coarse = torques + M, fine = torques + N;
    const int timing = M * (LEGS + 1) * (torques + 1) + LEGS * M * LEGS * M;
    const int samples = N + N + 2 * LEGS * N; /* times, pieces; angles predicted and read */
    const int legs = timing + (U + 1) * (coarse + fine) + samples + X * fine + LEGS * M * (M + 1);
    return legs + X * (n + 1) * coarse + stewart_kalman_scratch(n, LEGS * M) + N;
}

static int pose_changes(const stewart_filter *filter, const real *state, real *B, stewart_scratch scratch)
{
    const stewart_encoders *encoders = filter->sensing->kind;
    real *J = stewart_take(&scratch, LEGS * 6);
    return stewart_crank_jacobian(encoders->geometry, state, J)
           && stewart_solve(LEGS, filter->machine->estimated, J, B);
}

const stewart_encoder_step stewart_encoder_filter_step = {attempt, attempt_scratch, pose_changes,
                                                         stewart_count_unchanged};

stewart_sensing stewart_encoder_filter_sensing(const void *sensor)
{
    stewart_sensing sensing = stewart_encoder_sensing(sensor);
    sensing.encoder_step = &stewart_encoder_filter_step;
    return sensing;
}
