/* The Riccati equation P = Q + A'P (I + G P)^-1 A, G = B R^-1 B', by doubling: see riccati.h.

   One step of the recursion with A_0 = A, G_0 = G, H_0 = Q (Chu, Fan, Lin and Wang, 2004),

       W = I + G_k H_k
       A_{k+1} = A_k W^-1 A_k
       G_{k+1} = G_k + A_k W^-1 G_k A_k'
       H_{k+1} = H_k + A_k' H_k W^-1 A_k,

   goes twice as far back in time as all before it: H_k is the cost of the first 2^k samples, and P
   its limit. A_k = (I + G_k P) (A - B K)^(2^k) vanishes where, and only where, the loop is stable.
   G, H, H W^-1 and W^-1 G are symmetric, so that every product is one of rows by rows, X'Y. */

#include "riccati.h"

#define INPUTS STEWART_INPUTS
#define DOUBLINGS 40 /* 2^40 samples: longer than any loop takes to settle */
#define BLOCK 6      /* columns: what a tile has, and a divisor of n */

#ifdef STEWART_FLOAT
#define VANISHED 1e-4f
#define NOTED_RESIDUAL 1e-4f
#define LARGEST_RESIDUAL 1e-2f
#else
#define VANISHED 1e-9
#define NOTED_RESIDUAL 1e-13 /* above rounding; needed in one of some hundred badly scaled designs */
#define LARGEST_RESIDUAL 1e-4 /* as in law/riccati.py, relative to the solution */
#endif

/* Number of columns of rows i and i + 1 up to the diagonal, in whole blocks; i is even. */
static int columns_below(int i) { return (i / BLOCK + 1) * BLOCK; }

static void mirror(int n, real *S)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            S[n * j + i] = S[n * i + j];
}

/* S <- S + X'Y of (k, n), where X'Y is symmetric. */
static void add_symmetric(int n, int k, const real *X, const real *Y, real *S)
{
    for (int i = 0; i < n; i += 2)
        stewart_two_rows(STEWART_ADD, k, X + i, X + i + 1, n, Y, n, columns_below(i), S + n * i,
                         S + n * (i + 1));
    mirror(n, S);
}

/* x_j <- f (x_j - c y_j) */
static void reduce(int columns, real f, real c, const real *y, real *x)
{
    for (int j = 0; j < columns; j++)
        x[j] = f * (x[j] - c * y[j]);
}

/* X <- L^-1 X of some columns, where L, of unit diagonal, has the first `known` columns of W below the
   diagonal and those of the identity after them. */
static void forward(int n, int known, const real *W, int columns, real *X)
{
    for (int i = 0; i < n; i += 2) {
        const real *w = W + n * i;
        real *x = X + n * i;
        stewart_two_rows(STEWART_SUBTRACT, i < known ? i : known, w, w + n, 1, X, n, columns, x,
                         x + n);
        if (i < known)
            reduce(columns, 1, w[n + i], x, x + n);
    }
}

/* W = L U with row pivoting, in the place of W, in blocks of columns; row k has changed its place with
   row pivot[k]. Returns 0 for a singular W. */
static int factor(int n, real *W, int *pivot)
{
    for (int first = 0; first < n; first += BLOCK) {
        forward(n, first, W, BLOCK, W + first);
        for (int k = first; k < first + BLOCK; k++) {
            int best = k;
            for (int i = k + 1; i < n; i++)
                if (REAL(fabs)(W[n * i + k]) > REAL(fabs)(W[n * best + k]))
                    best = i;
            if (!(REAL(fabs)(W[n * best + k]) > 0)) /* or NaN */
                return 0;
            pivot[k] = best;
            if (best != k)
                stewart_swap_rows(n, W + n * best, W + n * k);
            for (int i = k + 1; i < n; i++) {
                const real f = W[n * i + k] /= W[n * k + k];
                for (int j = k + 1; j < first + BLOCK; j++)
                    W[n * i + j] -= f * W[n * k + j];
            }
        }
    }
    return 1;
}

/* X <- W^-1 X (n, n) with the factors of W. A symmetric solution is computed up to the diagonal, then mirrored. */
static void solve(int n, const real *W, const int *pivot, int symmetric, real *X)
{
    for (int k = 0; k < n; k++)
        if (pivot[k] != k)
            stewart_swap_rows(n, X + n * pivot[k], X + n * k);
    forward(n, n, W, n, X);
    for (int i = n - 2; i >= 0; i -= 2) {
        const real *w = W + n * i + i;
        const int columns = symmetric ? columns_below(i) : n;
        real *x = X + n * i;
        stewart_two_rows(STEWART_SUBTRACT, n - i - 2, w + 2, w + n + 2, 1, x + 2 * n, n, columns, x,
                         x + n);
        reduce(columns, 1 / w[n + 1], 0, x, x + n);
        reduce(columns, 1 / w[0], w[1], x + n, x);
    }
    if (symmetric)
        mirror(n, X);
}

/* X <- L^-1 X (6, n), of a lower triangular L. */
static void solve_lower(int n, const real *L, real *X)
{
    for (int i = 0; i < INPUTS; i++) {
        for (int k = 0; k < i; k++)
            reduce(n, 1, L[INPUTS * i + k], X + n * k, X + n * i);
        reduce(n, 1 / L[(INPUTS + 1) * i], 0, X, X + n * i);
    }
}

/* X <- L'^-1 X (6, n) */
static void solve_upper(int n, const real *L, real *X)
{
    for (int i = INPUTS - 1; i >= 0; i--) {
        for (int k = i + 1; k < INPUTS; k++)
            reduce(n, 1, L[INPUTS * k + i], X + n * k, X + n * i);
        reduce(n, 1 / L[(INPUTS + 1) * i], 0, X, X + n * i);
    }
}

/* (R + B'P B) K = B'P A, with PA = P A and L L' = R + B'P B; returns 0 if that is not positive
   definite. */
static int gain(int n, const real *A, const real *B, const real *P, const real *R, real *PA,
                real *L, real *K, stewart_scratch scratch)
{
    real *PB = stewart_take(&scratch, n * INPUTS);
    stewart_multiply_transpose(n, n, INPUTS, P, B, PB);
    stewart_multiply_transpose(INPUTS, n, INPUTS, B, PB, L);
    for (int i = 0; i < INPUTS * INPUTS; i++)
        L[i] += R[i];
    if (!stewart_cholesky(INPUTS, L))
        return 0;
    stewart_multiply_transpose(n, n, n, P, A, PA);
    stewart_multiply_transpose(INPUTS, n, n, B, PA, K);
    solve_lower(n, L, K);
    solve_upper(n, L, K);
    return 1;
}

/* F = A - B K */
static void close_loop(int n, const real *A, const real *B, const real *K, real *F)
{
    stewart_copy(n * n, A, F);
    for (int i = 0; i < n; i += 2)
        stewart_two_rows(STEWART_SUBTRACT, INPUTS, B + INPUTS * i, B + INPUTS * (i + 1), 1, K, n, n,
                         F + n * i, F + n * (i + 1));
}

/* A_1, G_1 and H_1. As G_0 = B R^-1 B' is of rank 6, (R + B'Q B) K = B'Q A gives

       W^-1 A = A - B K,   W^-1 G_0 = B (R + B'Q B)^-1 B'.

   K is lost; returns 0 where R is not positive definite. */
static int double_once(int n, const real *A, const real *B, const real *Q, const real *R, real *K,
                       real *next, real *G, real *H, stewart_scratch scratch)
{
    real L[INPUTS * INPUTS], *QA = stewart_take(&scratch, n * n), *V = stewart_take(&scratch, n * n);
    stewart_copy(INPUTS * INPUTS, R, L);
    if (!stewart_cholesky(INPUTS, L))
        return 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < INPUTS; j++)
            K[n * j + i] = B[INPUTS * i + j];
    solve_lower(n, L, K);
    stewart_fill(n * n, 0, G);
    add_symmetric(n, INPUTS, K, K, G);
    stewart_copy(n * n, Q, H);
    if (!gain(n, A, B, Q, R, QA, L, K, scratch))
        return 0;
    close_loop(n, A, B, K, V);
    add_symmetric(n, n, QA, V, H);
    stewart_multiply(n, n, n, A, V, next);
    stewart_multiply(n, n, INPUTS, A, B, V);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < INPUTS; j++)
            K[n * j + i] = V[INPUTS * i + j];
    solve_lower(n, L, K);
    add_symmetric(n, INPUTS, K, K, G);
    return 1;
}

/* H <- its limit, from A_1, G_1 and H_1; A and G are overwritten. Returns the number of doublings, or 0.

   P - H_k = A_k' P (I + G_k P)^-1 A_k: no digit of P is missing once |A_k|^2 is that small. */
static int doubled(int n, real *A, real *G, real *H, stewart_scratch scratch)
{
    real *W = stewart_take(&scratch, n * n), *V = stewart_take(&scratch, n * n);
    real *next = stewart_take(&scratch, n * n), left = stewart_norm(n * n, A);
    int pivot[STEWART_MAX_ORDER], count = 1;
    for (; !(left < VANISHED); count++) {
        if (!isfinite(left) || count == DOUBLINGS)
            return 0;
        stewart_multiply_transpose(n, n, n, G, H, W);
        for (int i = 0; i < n; i++)
            W[(n + 1) * i] += 1;
        if (!factor(n, W, pivot))
            return 0;
        stewart_copy(n * n, A, V);
        solve(n, W, pivot, 0, V); /* W^-1 A */
        stewart_multiply_transpose(n, n, n, H, V, next);
        add_symmetric(n, n, A, next, H);
        stewart_transpose(n, A);
        stewart_multiply_transpose(n, n, n, A, V, next);
        left = stewart_norm(n * n, next);
        if (left < VANISHED) /* G is not needed any more */
            continue;
        stewart_copy(n * n, G, V);
        solve(n, W, pivot, 1, V); /* W^-1 G */
        stewart_multiply_transpose(n, n, n, V, A, W);
        add_symmetric(n, n, A, W, G);
        stewart_copy(n * n, next, A);
    }
    return count;
}

/* |E| / |P|, E = Q + A'P F - P, and F = A - B K. */
static real residual(int n, const real *A, const real *B, const real *Q, const real *P,
                     const real *PA, const real *K, real *F, real *E)
{
    close_loop(n, A, B, K, F);
    stewart_multiply_transpose(n, n, n, PA, F, E);
    for (int i = 0; i < n * n; i++)
        E[i] += Q[i] - P[i];
    return stewart_norm(n * n, E) / stewart_norm(n * n, P);
}

/* One step of Newton's from the residual E: P <- P + sum F^k' E F^k, F = A - B K (Kleinman, 1968),
   twice as many terms at a time. F and E are lost. */
static void correct(int n, real *F, real *E, real *P, stewart_scratch scratch)
{
    real *product = stewart_take(&scratch, n * n);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            E[n * j + i] = E[n * i + j] = (E[n * i + j] + E[n * j + i]) / 2;
    for (int count = 0; count < DOUBLINGS && stewart_norm(n * n, F) > (real)1e-3; count++) {
        stewart_multiply_transpose(n, n, n, E, F, product);
        add_symmetric(n, n, F, product, E);
        stewart_multiply(n, n, n, F, F, product);
        stewart_copy(n * n, product, F);
    }
    for (int i = 0; i < n * n; i++)
        P[i] += E[i];
}

int stewart_lqr_scratch(int n) { return 6 * n * n; }

int stewart_lqr(int n, const real *A, const real *B, const real *Q, const real *R, real *K, real *P,
                stewart_scratch scratch)
{
    real L[INPUTS * INPUTS], *H = stewart_take(&scratch, n * n);
    stewart_scratch rest = scratch;
    real *G = stewart_take(&rest, n * n), *power = stewart_take(&rest, n * n);
    if (!double_once(n, A, B, Q, R, K, power, G, H, rest))
        return 0;
    const int count = doubled(n, power, G, H, rest);
    if (!count)
        return 0;
    rest = scratch;
    real *PA = stewart_take(&rest, n * n), *F = stewart_take(&rest, n * n);
    real *E = stewart_take(&rest, n * n);
    if (!gain(n, A, B, H, R, PA, L, K, rest))
        return 0;
    const real left = residual(n, A, B, Q, H, PA, K, F, E);
    if (!(left <= LARGEST_RESIDUAL)) /* or NaN */
        return 0;
    if (left > NOTED_RESIDUAL) {
        correct(n, F, E, H, rest);
        if (!gain(n, A, B, H, R, PA, L, K, rest))
            return 0;
    }
    if (P)
        stewart_copy(n * n, H, P);
    return count;
}
