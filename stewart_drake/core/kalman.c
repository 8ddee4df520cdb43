/* See kalman.h. */

#include "kalman.h"
#include "short.h"

#define MAX STEWART_MAX_BOUNDED
#define BEYOND ((real)1e-9) /* standard deviations out of bounds that are rounding */
#ifdef STEWART_FLOAT
#define ROUNDING ((real)1e-5) /* of a variance, as a share */
#else
#define ROUNDING ((real)1e-13)
#endif

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

/* The same of six columns, with sums that have names: see stewart_two_rows. */
static void reflect_six(int n, int m, real v, const real *f, real beta, real *row, real *W)
{
    const real *last = f + n * (m - 1), *g = f, *w = W;
    real s0 = v * row[0], s1 = v * row[1], s2 = v * row[2];
    real s3 = v * row[3], s4 = v * row[4], s5 = v * row[5];
    for (;; g += n, w += n) {
        s0 += *g * w[0];
        s1 += *g * w[1];
        s2 += *g * w[2];
        s3 += *g * w[3];
        s4 += *g * w[4];
        s5 += *g * w[5];
        if (g == last)
            break;
    }
    s0 /= beta;
    s1 /= beta;
    s2 /= beta;
    s3 /= beta;
    s4 /= beta;
    s5 /= beta;
    row[0] -= v * s0;
    row[1] -= v * s1;
    row[2] -= v * s2;
    row[3] -= v * s3;
    row[4] -= v * s4;
    row[5] -= v * s5;
    for (;; f += n, W += n) {
        const real g0 = *f;
        W[0] -= g0 * s0;
        W[1] -= g0 * s1;
        W[2] -= g0 * s2;
        W[3] -= g0 * s3;
        W[4] -= g0 * s4;
        W[5] -= g0 * s5;
        if (f == last)
            break;
    }
}

/* Householder reflections of row k of R and all rows of W make column k of W zero. */
void stewart_absorb(int n, int m, real *R, real *W)
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
    stewart_absorb(n, n + k, R, W);
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

int stewart_root(int n, real *P)
{
    for (int j = 0; j < n; j++) {
        real *row = P + n * j, left = row[j], scale = 0;
        const real least = ROUNDING * row[j];
        for (int k = 0; k < j; k++)
            left -= row[k] * row[k];
        if (!(left >= -least)) /* or NaN */
            return 0;
        if (left > least)
            scale = 1 / REAL(sqrt)(left);
        row[j] = scale > 0 ? REAL(sqrt)(left) : 0;
        for (int i = j + 1; i < n; i++) {
            real *below = P + n * i, sum = below[j];
            for (int k = 0; k < j; k++)
                sum -= below[k] * row[k];
            below[j] = sum * scale;
        }
        for (int i = j + 1; i < n; i++)
            row[i] = 0;
    }
    return stewart_all_finite(n * n, P);
}

static real clipped(real x, real lower, real upper)
{
    return x < lower ? lower : x > upper ? upper : x;
}

/* Active set: components at a bound. */
typedef struct {
    int number, at[MAX], upper[MAX];
    real value[MAX], push[MAX];
} Active;

/* push = P_hh^-1 (mean_h - value_h), after releasing components that are pushed inwards. */
static int find_pushes(Active *h, int n, const real *mean, const real *L, real *P)
{
    while (h->number) {
        int least = 0;
        real inwards = INFINITY;
        for (int a = 0; a < h->number; a++) {
            h->push[a] = mean[h->at[a]] - h->value[a];
            for (int b = 0; b < h->number; b++)
                P[h->number * a + b] = stewart_dot(n, L + n * h->at[a], L + n * h->at[b]);
        }
        if (!stewart_solve(h->number, 1, P, h->push) || !stewart_all_finite(h->number, h->push))
            return 0;
        for (int a = 0; a < h->number; a++) {
            const real push = h->upper[a] ? h->push[a] : -h->push[a];
            if (push < inwards) {
                inwards = push;
                least = a;
            }
        }
        if (inwards >= 0)
            return 1;
        h->number--;
        for (int a = least; a < h->number; a++) {
            h->at[a] = h->at[a + 1];
            h->upper[a] = h->upper[a + 1];
            h->value[a] = h->value[a + 1];
        }
    }
    return 0;
}

/* Fixing components at bounds moves all that is correlated with them along their columns of P = L L',
   so that what the measurements have said about combinations of them is kept. Which ones are fixed is
   found by adding the one furthest out and freeing those that are held back from inside. The
   covariance stays: a component at its bound may leave it again. */
int stewart_within_bounds(int n, const real *mean, const real *L, const real *lower,
                          const real *upper, real *moved, stewart_scratch scratch)
{
    real *along = stewart_take(&scratch, n), *P = stewart_take(&scratch, MAX * MAX);
    Active h = {0};
    stewart_copy(n, mean, moved);
    for (int round = 0; round < 4 * MAX; round++) {
        int worst = -1, place = 0;
        real furthest = BEYOND;
        for (int i = 0; i < n; i++) {
            const real beyond = moved[i] - clipped(moved[i], lower[i], upper[i]);
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
        while (place < h.number && h.at[place] != worst)
            place++;
        if (place == MAX)
            return 0;
        h.number += place == h.number;
        h.at[place] = worst;
        h.upper[place] = moved[worst] > upper[worst];
        h.value[place] = h.upper[place] ? upper[worst] : lower[worst];
        if (!find_pushes(&h, n, mean, L, P))
            return 0;
        stewart_fill(n, 0, along);
        for (int a = 0; a < h.number; a++)
            for (int i = 0; i < n; i++)
                along[i] += h.push[a] * L[n * h.at[a] + i];
        for (int i = 0; i < n; i++)
            moved[i] = mean[i] - stewart_dot(n, L + n * i, along);
    }
    for (int i = 0; i < n; i++)
        moved[i] = clipped(moved[i], lower[i], upper[i]);
    return 1;
}

int stewart_kalman_scratch(int n, int most)
{
    return most + most * n + (most + n + 1) * (n + 1) + 2 * n + MAX * MAX;
}

/* With the residuals whitened the mean is the minimum over z, xi = mean + L z, of

       |W z - (e + H (xi_0 - mean))|^2 + |z|^2,   W = H L,

   about the xi_0 where it was linearised. QR of [W wanted; 1 0] to [R c; 0 d] solves it:

       R'R = 1 + W'W,   z = R^-1 c,   P = L (1 + W'W)^-1 L' = L R^-1 (L R^-1)',

   nu' S^-1 nu = d^2 and |S| / |C C'| = |1 + W W'| = |R|^2. No covariance is subtracted from another. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *spread, stewart_scratch scratch)
{
    const int n = filter->n, N = n + 1;
    real *e = stewart_take(&scratch, filter->most), *H = stewart_take(&scratch, filter->most * n);
    real *R = stewart_take(&scratch, N * N), *W = stewart_take(&scratch, filter->most * N);
    real *moved = stewart_take(&scratch, n);
    for (int round = 0; round < filter->iterations; round++) {
        const int m = filter->rows(filter->model, xi, e, H, scratch);
        if (m < 0)
            return 0;
        for (int k = 0; k < n; k++)
            moved[k] = xi[k] - filter->mean[k];
        for (int i = 0; i < m; i += 2) { /* the last of an odd number of rows twice */
            const real *h = H + n * i, *next = i + 1 < m ? h + n : h;
            real *w = W + N * i, *other = i + 1 < m ? w + N : w;
            stewart_two_rows(STEWART_SET, n, h, next, 1, filter->root, n, n, w, other);
        }
        for (int i = 0; i < m; i++)
            W[N * i + n] = e[i] + stewart_dot(n, H + n * i, moved);
        for (int i = 0; i < m && filter->innovations; i++) {
            filter->innovations[i] = W[N * i + n];
            filter->variances[i] = 1 + stewart_dot(n, W + N * i, W + N * i);
        }
        stewart_fill(N * N, 0, R);
        for (int i = 0; i < n; i++)
            R[(N + 1) * i] = 1;
        stewart_absorb(N, m, R, W);
        *spread = 0;
        for (int i = 0; i < n; i++)
            *spread += 2 * REAL(log)(REAL(fabs)(R[(N + 1) * i]));
        *distance = R[N * n + n] * R[N * n + n];
        if (round == 0 && filter->hopeless > 0 && !(*distance <= filter->hopeless)) /* or NaN */
            return 0;
        for (int i = 0; i < n; i++) { /* root R = L, row by row */
            const real *l = filter->root + n * i;
            real *x = root + n * i;
            real better = filter->mean[i];
            stewart_copy(n, l, x);
            for (int j = 0; j < n; j++) {
                x[j] /= R[N * j + j];
                for (int k = j + 1; k < n; k++)
                    x[k] -= x[j] * R[N * j + k];
                better += x[j] * R[N * j + n];
            }
            moved[i] = better;
        }
        stewart_copy(n, moved, R);
        if (!stewart_within_bounds(n, R, root, filter->lower, filter->upper, moved, scratch))
            return 0;
        const int settled = filter->settle(filter->model, xi, moved, scratch);
        stewart_copy(n, moved, xi);
        if (settled < 0)
            return 0;
        if (settled)
            break;
    }
    return 1;
}
