#include "kalman.h"
#include "short.h"

/* Unrolled, a loop over six columns keeps its sums in registers, see stewart_two_rows. */
#if defined(__GNUC__) && !defined(__clang__)
#define UNROLLED _Pragma("GCC unroll 6")
#else
#define UNROLLED
#endif

#define BOUND_TOLERANCE ((real)1e-9) /* standard deviations; less out of bounds counts as rounding */

/* A reflection of one column x of [row; W], rows of W being n numbers apart, by v = [v; f]:

       s = v'x / beta,   x <- x - s v. */
static void reflect(int n, int m, real v, const real *f, real beta, real *row, real *W)
{
    real s = v * *row;
    for (int i = 0; i < m; i++)
        s += f[n * i] * W[n * i];
    s /= beta;
    *row -= v * s;
    for (int i = 0; i < m; i++)
        W[n * i] -= f[n * i] * s;
}

/* The same for six columns at once. */
static void reflect_six(int n, int m, real v, const real *f, real beta, real *row, real *W)
{
    const real *last = f + n * (m - 1), *g = f, *w = W;
    real s[6];
    UNROLLED
    for (int i = 0; i < 6; i++)
        s[i] = v * row[i];
    for (;; g += n, w += n) {
        UNROLLED
        for (int i = 0; i < 6; i++)
            s[i] += *g * w[i];
        if (g == last)
            break;
    }
    UNROLLED
    for (int i = 0; i < 6; i++) {
        s[i] /= beta;
        row[i] -= v * s[i];
    }
    for (;; f += n, W += n) {
        const real g0 = *f;
        UNROLLED
        for (int i = 0; i < 6; i++)
            W[i] -= g0 * s[i];
        if (f == last)
            break;
    }
}

/* Householder reflections of row k of R and all rows of W make column k of W zero. */
void stewart_add_root(int n, int m, real *R, real *W)
{
    for (int k = 0; k < n && m > 0; k++) {
        real *row = R + n * k, square = row[k] * row[k];
        int j = k + 1;
        for (int i = 0; i < m; i++)
            square += W[n * i + k] * W[n * i + k];
        real alpha = REAL(sqrt)(square);
        if (row[k] > 0)
            alpha = -alpha;
        const real v = row[k] - alpha, beta = -v * alpha; /* |v|^2 / 2 of v = column - alpha e1 */
        if (beta == 0) /* the column is 0 already; NaN stays NaN */
            continue;
        for (; j + 6 <= n; j += 6)
            reflect_six(n, m, v, W + k, beta, row + j, W + j);
        for (; j < n; j++)
            reflect(n, m, v, W + k, beta, row + j, W + j);
        row[k] = alpha;
    }
}

void stewart_root_of_prediction(int n, const real *H, const real *std, const real *walk, int k,
                                const real *K, real *L, stewart_scratch scratch)
{
    real *R = stewart_take(&scratch, n * n), *W = stewart_take(&scratch, n * (n + k));
    stewart_fill(n * n, 0, R);
    for (int i = 0; i < n; i++)
        R[(n + 1) * i] = i < X ? std[i] : walk[i - X];
    for (int i = 0; i < n; i++) /* W = (F L)' */
        for (int j = 0; j < n; j++)
            W[n * j + i] = L[n * i + j];
    for (int j = 0; j < n; j++) {
        real *w = W + n * j, moved[X];
        for (int i = 0; i < X; i++)
            moved[i] = stewart_dot(n, H + n * i, w);
        stewart_copy(X, moved, w);
    }
    for (int row = 0; row < k; row++) {
        stewart_fill(n, 0, W + n * (n + row));
        stewart_copy(X, K + X * row, W + n * (n + row));
    }
    stewart_add_root(n, n + k, R, W);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            L[n * i + j] = j <= i ? R[n * j + i] : 0;
}

void stewart_widen_root(int n, const real *jump, real *L, stewart_scratch scratch)
{
    real *same = stewart_take(&scratch, X * n), none[X];
    stewart_fill(X * n, 0, same);
    stewart_fill(X, 0, none);
    for (int i = 0; i < X; i++)
        same[(n + 1) * i] = 1;
    stewart_root_of_prediction(n, same, none, jump, 0, NULL, L, scratch);
}

/* Components that are fixed at a bound, with their Lagrange multipliers. */
typedef struct {
    int number, index[STEWART_MAX_BOUNDED], upper[STEWART_MAX_BOUNDED];
    real value[STEWART_MAX_BOUNDED], multiplier[STEWART_MAX_BOUNDED];
} ActiveSet;

/* Solve P_aa multiplier = mean_a - value_a for the set a, and release components one by one whose
   multiplier points into the bounds. Returns 0 if P_aa is singular or none is left. */
static int find_multipliers(ActiveSet *set, int n, const real *mean, const real *L, real *P)
{
    while (set->number) {
        int released = 0;
        real smallest = INFINITY;
        for (int a = 0; a < set->number; a++) {
            set->multiplier[a] = mean[set->index[a]] - set->value[a];
            for (int b = 0; b < set->number; b++)
                P[set->number * a + b] = stewart_dot(n, L + n * set->index[a], L + n * set->index[b]);
        }
        if (!stewart_solve(set->number, 1, P, set->multiplier)
            || !stewart_all_finite(set->number, set->multiplier))
            return 0;
        for (int a = 0; a < set->number; a++) {
            const real multiplier = set->upper[a] ? set->multiplier[a] : -set->multiplier[a];
            if (multiplier < smallest) {
                smallest = multiplier;
                released = a;
            }
        }
        if (smallest >= 0)
            return 1;
        set->number--;
        for (int a = released; a < set->number; a++) {
            set->index[a] = set->index[a + 1];
            set->upper[a] = set->upper[a + 1];
            set->value[a] = set->value[a + 1];
        }
    }
    return 0;
}

/* Active set method for min (z - mean)' P^-1 (z - mean) within the bounds, P = L L': z = mean - P_:a
   multiplier. Components that are correlated with a fixed one move with it, so that measured combinations
   of them are kept. Each round fixes the component that is furthest out, and releases those whose
   multiplier has the wrong sign. The covariance stays: a component at its bound may leave it again. */
int stewart_within_bounds(int n, const real *mean, const real *L, const real *lower,
                          const real *upper, real *bounded, stewart_scratch scratch)
{
    real *shift = stewart_take(&scratch, n), *P = stewart_take(&scratch, STEWART_MAX_BOUNDED * STEWART_MAX_BOUNDED);
    ActiveSet set = {0};
    stewart_copy(n, mean, bounded);
    for (int round = 0; round < 4 * STEWART_MAX_BOUNDED; round++) {
        int worst = -1, slot = 0;
        real furthest = BOUND_TOLERANCE;
        for (int i = 0; i < n; i++) {
            const real beyond = bounded[i] - clamped(lower[i], bounded[i], upper[i]);
            if (beyond == 0)
                continue;
            const real excess = REAL(fabs)(beyond) / stewart_norm(n, L + n * i);
            if (!isfinite(excess))
                return 0;
            if (excess > furthest) {
                furthest = excess;
                worst = i;
            }
        }
        if (worst < 0)
            break;
        while (slot < set.number && set.index[slot] != worst)
            slot++;
        if (slot == STEWART_MAX_BOUNDED)
            return 0;
        set.number += slot == set.number;
        set.index[slot] = worst;
        set.upper[slot] = bounded[worst] > upper[worst];
        set.value[slot] = set.upper[slot] ? upper[worst] : lower[worst];
        if (!find_multipliers(&set, n, mean, L, P))
            return 0;
        stewart_fill(n, 0, shift);
        for (int a = 0; a < set.number; a++)
            for (int i = 0; i < n; i++)
                shift[i] += set.multiplier[a] * L[n * set.index[a] + i];
        for (int i = 0; i < n; i++)
            bounded[i] = mean[i] - stewart_dot(n, L + n * i, shift);
    }
    for (int i = 0; i < n; i++)
        bounded[i] = clamped(lower[i], bounded[i], upper[i]);
    return 1;
}

int stewart_kalman_scratch(int n, int max_rows)
{
    const int active = STEWART_MAX_BOUNDED * STEWART_MAX_BOUNDED;
    return max_rows + max_rows * n + (max_rows + n + 1) * (n + 1) + 5 * n + active;
}

/* With whitened residuals the updated mean is xi = mean + L z, with z the minimum of

       |W z - nu|^2 + |z|^2,   W = H L,   nu = e + H (xi_0 - mean),

   linearised at xi_0. QR of [W nu; 1 0] to [R c; 0 d] solves it:

       R'R = 1 + W'W,   z = R^-1 c,   P = L (1 + W'W)^-1 L' = L R^-1 (L R^-1)',

   nu' S^-1 nu = d^2 and |S| / |C C'| = |1 + W W'| = |R|^2. No covariance is subtracted from another. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *log_ratio, stewart_scratch scratch)
{
    const int n = filter->n, N = n + 1;
    real *e = stewart_take(&scratch, filter->max_rows), *H = stewart_take(&scratch, filter->max_rows * n);
    real *R = stewart_take(&scratch, N * N), *W = stewart_take(&scratch, filter->max_rows * N);
    real *change = stewart_take(&scratch, n), *updated = stewart_take(&scratch, n);
    real *shift = stewart_take(&scratch, n), *low = stewart_take(&scratch, n); /* xi - mean; of the mean */
    stewart_fill(n, 0, low);
    if (filter->low)
        stewart_copy(X, filter->low, low);
    for (int i = 0; i < n; i++)
        shift[i] = xi[i] - filter->mean[i];
    for (int round = 0; round < filter->iterations; round++) {
        const int m = filter->residuals(filter->context, xi, e, H, scratch);
        if (m < 0)
            return 0;
        for (int i = 0; i < m; i += 2) { /* the last of an odd number of rows twice */
            const real *h = H + n * i, *next = i + 1 < m ? h + n : h;
            real *w = W + N * i, *other = i + 1 < m ? w + N : w;
            stewart_two_rows(STEWART_SET, n, h, next, 1, filter->root, n, n, w, other);
        }
        for (int i = 0; i < m; i++)
            W[N * i + n] = e[i] + stewart_dot(n, H + n * i, shift);
        for (int i = 0; i < m && filter->innovations; i++) {
            filter->innovations[i] = W[N * i + n];
            filter->variances[i] = 1 + stewart_dot(n, W + N * i, W + N * i);
        }
        stewart_fill(N * N, 0, R);
        for (int i = 0; i < n; i++)
            R[(N + 1) * i] = 1;
        stewart_add_root(N, m, R, W);
        *log_ratio = 0;
        for (int i = 0; i < n; i++)
            *log_ratio += 2 * REAL(log)(REAL(fabs)(R[(N + 1) * i]));
        *distance = R[N * n + n] * R[N * n + n];
        if (round == 0 && filter->max_distance > 0 && !(*distance <= filter->max_distance)) /* or NaN */
            return 0;
        for (int i = 0; i < n; i++) { /* root R = L, row by row */
            const real *l = filter->root + n * i;
            real *x = root + n * i;
            real sum = 0;
            stewart_copy(n, l, x);
            for (int j = 0; j < n; j++) {
                x[j] /= R[N * j + j];
                for (int k = j + 1; k < n; k++)
                    x[k] -= x[j] * R[N * j + k];
                sum += x[j] * R[N * j + n];
            }
            change[i] = sum - shift[i];
            shift[i] = sum;
            sum += low[i];
            updated[i] = filter->mean[i] + sum;
            if (filter->low && i < X)
                filter->low[i] = sum - (updated[i] - filter->mean[i]);
        }
        stewart_copy(n, updated, R);
        if (!stewart_within_bounds(n, R, root, filter->lower, filter->upper, updated, scratch))
            return 0;
        for (int i = 0; i < n; i++) {
            change[i] += updated[i] - R[i];
            shift[i] += updated[i] - R[i];
        }
        const int status = filter->relinearize(filter->context, change, updated, scratch);
        stewart_copy(n, updated, xi);
        if (status < 0)
            return 0;
        if (status)
            break;
    }
    return 1;
}
