#include "encoders.h"
#include "short.h"

#define MAX_NODES 3
#define LEAST_PRESENT ((real)0.3) /* least part of a leg's samples that must be present for it to count */
/* An outlier is off the median by more than each of these (Hampel): */
#define OUTLIER_DEVIATIONS 8   /* median absolute deviations */
#define OUTLIER_SPANS 3        /* spans from the 10th to the 90th percentile: residuals may be curved */
#define OUTLIER_QUANTA 3       /* widths of a code */
#define LEAST_QUANTUM ((real)3e-7) /* rad, least width of a code in that test, for errors of the model's angles */
#define LAST_FEW 9          /* last samples that the line of `last_angle` fits */
#define PAIRS (LAST_FEW * (LAST_FEW - 1) / 2)

/* Whether `number` of N samples are enough for a leg. */
static int is_enough(const stewart_encoders *encoders, int N, int number)
{
    return number >= (N > 1 ? encoders->nodes : 1) && (real)number >= LEAST_PRESENT * (real)N;
}

/* Time of sample n, with the period as the interval [-1, 1] of the Legendre polynomials. */
static real legendre_time(const stewart_encoders *encoders, int n)
{
    return 2 * (real)(n + 1) / (real)encoders->samples - 1;
}

/* Legendre polynomials of degrees 0 to 2. */
static void legendre(real t, real *v)
{
    v[0] = 1;
    v[1] = t;
    v[2] = (3 * t * t - 1) / 2;
}

static void sort(int n, real *x)
{
    for (int gap = n / 2; gap > 0; gap /= 2)
        for (int i = gap; i < n; i++) {
            const real value = x[i];
            int j = i;
            for (; j >= gap && x[j - gap] > value; j -= gap)
                x[j] = x[j - gap];
            x[j] = value;
        }
}

/* Interpolated quantile of sorted numbers (n) for a probability p. */
static real quantile(int n, const real *sorted, real p)
{
    const real place = p * (real)(n - 1);
    int below = (int)place;
    if (below > n - 2)
        below = n > 1 ? n - 2 : 0;
    const real next = n > 1 ? sorted[below + 1] : sorted[below];
    return sorted[below] + (place - (real)below) * (next - sorted[below]);
}

static real median(int n, const real *sorted)
{
    return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) / 2;
}

static void predict_encoders(const stewart_sensing *sensing, const real *state, real *values)
{
    const stewart_encoders *encoders = sensing->kind;
    stewart_crank_angles(encoders->geometry, state, values);
    for (int i = 0; i < LEGS; i++)
        values[i] += encoders->offset[i];
    for (int n = LEGS; n < sensing->size; n += LEGS)
        stewart_copy(LEGS, values, values + n);
}

static void jacobian_of_encoders(const stewart_sensing *sensing, const real *state, real *J)
{
    const stewart_encoders *encoders = sensing->kind;
    real one[LEGS * 6];
    stewart_crank_jacobian(encoders->geometry, state, one);
    stewart_fill(sensing->size * X, 0, J);
    for (int row = 0; row < sensing->size; row++)
        stewart_copy(6, one + 6 * (row % LEGS), J + X * row);
}

/* Angle (rad) of a leg at the last sample, NaN where it is unknown. With more than MAX_NODES samples it is
   the end of a line through the last few, robust to outliers (Theil and Sen). */
static real last_angle(int N, const real *values, int leg)
{
    real t[LAST_FEW], y[LAST_FEW], slopes[PAIRS];
    int number = 0, pairs = 0;
    for (int n = N - 1; n >= 0 && number < LAST_FEW; n--)
        if (isfinite(values[LEGS * n + leg])) {
            t[number] = (real)(n + 1) / (real)N - 1;
            y[number++] = values[LEGS * n + leg];
        }
    if (number <= MAX_NODES)
        return number && t[0] == 0 ? y[0] : (real)NAN;
    for (int i = 0; i < number; i++)
        for (int j = 0; j < i; j++)
            slopes[pairs++] = (y[j] - y[i]) / (t[j] - t[i]);
    sort(pairs, slopes);
    for (int i = 0; i < number; i++)
        y[i] -= median(pairs, slopes) * t[i];
    sort(number, y);
    return median(number, y);
}

/* Pose by forward kinematics, with the expected rates. To first order its covariance is P = J^-1 R J^-T.
   A leg without values has its expected angle, with the size of the motion as standard deviation. */
static int start_of_encoders(const stewart_sensing *sensing, const real *values, const real *near,
                             real *state, real *root, stewart_scratch scratch)
{
    const stewart_encoders *encoders = sensing->kind;
    real *J = stewart_take(&scratch, LEGS * 6), *inverse = stewart_take(&scratch, LEGS * 6);
    real angles[LEGS], std[LEGS];
    int known[LEGS];
    const real *expected = near && stewart_all_finite(X, near) ? near : encoders->initial_state;
    stewart_crank_angles(encoders->geometry, expected, angles);
    for (int leg = 0; leg < LEGS; leg++) {
        const real angle = last_angle(sensing->size / LEGS, values, leg);
        known[leg] = isfinite(angle);
        if (known[leg])
            angles[leg] = angle - encoders->offset[leg];
    }
    stewart_copy(X, expected, state);
    if (!stewart_all_finite(LEGS, angles)
        || !stewart_forward_kinematics(encoders->geometry, angles, state, scratch)
        || !stewart_crank_jacobian(encoders->geometry, state, J))
        return 0;
    stewart_fill(LEGS * 6, 0, inverse);
    for (int leg = 0; leg < LEGS; leg++) {
        std[leg] = encoders->std;
        for (int i = 0; i < 6 && !known[leg]; i++)
            std[leg] = (i ? std[leg] : 0) + REAL(fabs)(J[6 * leg + i]) * encoders->motion[i];
        inverse[(LEGS + 1) * leg] = 1; /* identity, which `stewart_solve` turns into J^-1 */
    }
    if (!stewart_solve(6, LEGS, J, inverse))
        return 0;
    stewart_fill(X * X, 0, root);
    for (int i = 0; i < 6; i++) {
        for (int leg = 0; leg < LEGS; leg++)
            root[X * i + leg] = inverse[LEGS * i + leg] * std[leg];
        root[(X + 1) * (6 + i)] = encoders->rates_std[i];
    }
    return 1;
}

static int fault_of_encoders(const stewart_sensing *sensing, const real *geometry, real period,
                             const real *values, const real *last)
{
    const int N = sensing->size / LEGS;
    (void)geometry, (void)period, (void)last;
    for (int leg = 0; leg < LEGS; leg++) {
        int number = 0;
        for (int n = 0; n < N; n++)
            number += isfinite(values[LEGS * n + leg]) != 0;
        if (is_enough(sensing->kind, N, number))
            return 0;
    }
    return STEWART_MISSING;
}

stewart_sensing stewart_encoder_sensing(const void *sensor)
{
    const stewart_encoders *encoders = sensor;
    return (stewart_sensing){LEGS * encoders->samples, encoders->noise_std, encoders, predict_encoders,
                             jacobian_of_encoders, start_of_encoders, fault_of_encoders, NULL};
}

stewart_sensing stewart_newest_encoder_sensing(const void *sensor)
{
    stewart_sensing sensing = stewart_encoder_sensing(sensor);
    sensing.size = LEGS;
    return sensing;
}

/* Number of changes of a leg's code since the last sample of the period before. */
static int changes_of(const stewart_encoders *encoders, const real *values, const real *last, int leg)
{
    real before = last[LEGS * (encoders->samples - 1) + leg];
    int changes = 0;
    for (int n = 0; n < encoders->samples; n++) {
        const real value = values[LEGS * n + leg];
        if (!isfinite(value))
            continue;
        changes += isfinite(before) && value != before;
        before = value;
    }
    return changes;
}

void stewart_count_unchanged(const stewart_sensing *sensing, const real *values, const real *last,
                             real *unchanged)
{
    const stewart_encoders *encoders = sensing->kind;
    for (int leg = 0; leg < LEGS; leg++) {
        int present = 0;
        for (int n = 0; n < encoders->samples; n++)
            present |= isfinite(values[LEGS * n + leg]) != 0;
        if (present)
            unchanged[leg] = changes_of(encoders, values, last, leg) ? 0 : unchanged[leg] + 1;
    }
}

/* Replace outliers of a leg within a period (Hampel) by NaN. Returns whether there are any. */
static int reject_outliers(const stewart_encoders *encoders, const real *predicted, int leg, real *values,
                           stewart_scratch scratch)
{
    real *sorted = stewart_take(&scratch, encoders->samples);
    int number = 0, found = 0;
    for (int n = 0; n < encoders->samples; n++) {
        real *value = values + LEGS * n + leg;
        const real residual = *value - encoders->offset[leg] - predicted[LEGS * n + leg];
        if (isfinite(residual))
            sorted[number++] = residual;
        else if (isfinite(*value)) { /* the model is out of reach */
            *value = (real)NAN;
            found = 1;
        }
    }
    if (!number)
        return found;
    sort(number, sorted);
    const real middle = median(number, sorted);
    const real span = quantile(number, sorted, (real)0.9) - quantile(number, sorted, (real)0.1);
    for (int i = 0; i < number; i++)
        sorted[i] = REAL(fabs)(sorted[i] - middle);
    sort(number, sorted);
    const real least = OUTLIER_QUANTA * REAL(fmax)(encoders->quantum, LEAST_QUANTUM);
    const real bound =
        REAL(fmax)(REAL(fmax)(OUTLIER_SPANS * span, least), OUTLIER_DEVIATIONS * median(number, sorted));
    for (int n = 0; n < encoders->samples; n++) {
        real *value = values + LEGS * n + leg;
        const real residual = *value - encoders->offset[leg] - predicted[LEGS * n + leg];
        if (isfinite(*value) && !(REAL(fabs)(residual - middle) <= bound)) {
            *value = (real)NAN;
            found = 1;
        }
    }
    return found;
}

/* Fit the samples of a leg that are present: compute K (M, M) = V(s) (V'V)^-1, and sum_n G_jn^2 (M) with
   G = K V'. Returns 0 if V'V is singular. */
static int fit_at_nodes(const stewart_encoders *encoders, const real *values, int leg, real *K,
                        real *squares)
{
    const int M = encoders->nodes;
    real gram[MAX_NODES * MAX_NODES] = {0}, v[MAX_NODES], nodes[MAX_NODES * MAX_NODES];
    for (int n = 0; n < encoders->samples; n++) {
        if (!isfinite(values[LEGS * n + leg]))
            continue;
        legendre(legendre_time(encoders, n), v);
        for (int a = 0; a < M; a++)
            for (int b = 0; b < M; b++)
                gram[M * a + b] += v[a] * v[b];
    }
    for (int j = 0; j < M; j++) {
        legendre(2 * encoders->node_times[j] - 1, v);
        for (int a = 0; a < M; a++)
            nodes[M * a + j] = v[a];
    }
    real at_nodes[MAX_NODES * MAX_NODES]; /* V(s)'; the solution overwrites `nodes` */
    stewart_copy(M * M, nodes, at_nodes);
    if (!stewart_solve(M, M, gram, nodes))
        return 0;
    for (int j = 0; j < M; j++) {
        squares[j] = 0;
        for (int a = 0; a < M; a++) {
            K[M * j + a] = nodes[M * a + j];
            squares[j] += at_nodes[M * a + j] * nodes[M * a + j];
        }
    }
    return 1;
}

void stewart_read(const stewart_encoders *encoders, const real *values, const real *predicted,
                  const real *last, const real *unchanged, stewart_reading *reading,
                  stewart_scratch scratch)
{
    const int N = encoders->samples, M = encoders->nodes;
    real *angles = reading->angles, squares[MAX_NODES];
    reading->missing = !stewart_all_finite(LEGS * N, values);
    stewart_copy(LEGS * N, values, angles);
    for (int leg = 0; leg < LEGS; leg++) {
        real *K = reading->fit + M * M * leg, information = 1; /* independent samples over samples */
        int number = 0;
        reading->has_outliers[leg] =
            N > MAX_NODES && reject_outliers(encoders, predicted, leg, angles, scratch);
        for (int n = 0; n < N; n++)
            number += isfinite(angles[LEGS * n + leg]) != 0;
        const int counts = is_enough(encoders, N, number) && fit_at_nodes(encoders, angles, leg, K, squares);
        const int changes = changes_of(encoders, angles, last, leg);
        if (encoders->quantum > 0 && number) {
            information = (real)changes / (real)number;
            if (!changes) { /* 1 / (1 + c)^2 of a sample, see encoders.h */
                const real root = 1 + unchanged[leg];
                information = 1 / (root * root * (real)number);
            }
            information = information < 1 ? information : 1;
        }
        for (int j = 0; j < M; j++)
            reading->variance[LEGS * j + leg]
                = counts ? encoders->std * encoders->std * squares[j] / information : (real)INFINITY;
        for (int n = 0; n < N; n++)
            angles[LEGS * n + leg] -= encoders->offset[leg];
    }
}

void stewart_node_residuals(const stewart_encoders *encoders, const stewart_reading *reading,
                            const real *predicted, real *e)
{
    const int N = encoders->samples, M = encoders->nodes;
    for (int leg = 0; leg < LEGS; leg++) {
        const real *K = reading->fit + M * M * leg;
        real sums[MAX_NODES] = {0}, v[MAX_NODES];
        for (int n = 0; n < N; n++) {
            const real angle = reading->angles[LEGS * n + leg];
            if (!isfinite(angle))
                continue;
            legendre(legendre_time(encoders, n), v);
            for (int a = 0; a < M; a++)
                sums[a] += v[a] * (angle - predicted[LEGS * n + leg]);
        }
        for (int j = 0; j < M; j++) {
            e[LEGS * j + leg] = 0;
            for (int a = 0; a < M && isfinite(reading->variance[LEGS * j + leg]); a++)
                e[LEGS * j + leg] += K[M * j + a] * sums[a];
        }
    }
}

int stewart_encoder_scratch(const stewart_encoders *encoders)
{
    const int forward = LEGS * 6 + LEGS + 6; /* of `stewart_forward_kinematics` */
    return 2 * LEGS * 6 + forward + encoders->samples; /* J, inverse; residuals of a leg */
}
