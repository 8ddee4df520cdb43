/* The Riccati equation P = Q + A'P (I + G P)^-1 A, G = B R^-1 B', by doubling: see riccati.h.

   One step of the recursion with A_0 = A, G_0 = G, H_0 = Q (Chu, Fan, Lin and Wang, 2004),

       W = I + G_k H_k
       A_{k+1} = A_k W^-1 A_k
       G_{k+1} = G_k + A_k W^-1 G_k A_k'
       H_{k+1} = H_k + A_k' H_k W^-1 A_k,

   goes twice as far back in time as all before it: H_k is the cost of the first 2^k samples, and P
   its limit. A_k = (I + G_k P) (A - B K)^(2^k) vanishes where, and only where, the loop is stable. */

#include <string.h>

#include "riccati.h"

#define WIDTH STEWART_MAX_ORDER
#define INPUTS STEWART_INPUTS
#define DOUBLINGS 40 /* 2^40 samples: longer than any loop takes to settle */

#ifdef STEWART_FLOAT
#define VANISHED 1e-4f
#define NOTED_RESIDUAL 1e-4f
#define LARGEST_RESIDUAL 1e-2f
#else
#define VANISHED 1e-9
#define NOTED_RESIDUAL 1e-13 /* beyond rounding, for want of balance: one in some hundred designs */
#define LARGEST_RESIDUAL 1e-4 /* as of law/riccati.py: relative to the solution */
#endif

#define TILE 6 /* all matrices are of a multiple: so many sums at a time fit into registers */

typedef real rows[WIDTH]; /* of a matrix, the first n of them in use */

/* C = A B, of n rows and m columns; of a symmetric C (LOWER) at least what is not above the diagonal. */
enum { WHOLE, LOWER };

static void multiply(int n, int inner, int m, int part, rows *A, rows *B, rows *restrict C)
{
    for (int i = 0; i < n; i += 3)
        for (int j = 0; j < (part == LOWER ? i + 3 : m); j += TILE) {
            real a[TILE] = {0}, b[TILE] = {0}, c[TILE] = {0};
            for (int k = 0; k < inner; k++)
                for (int t = 0; t < TILE; t++) {
                    a[t] += A[i][k] * B[k][j + t];
                    b[t] += A[i + 1][k] * B[k][j + t];
                    c[t] += A[i + 2][k] * B[k][j + t];
                }
            memcpy(C[i] + j, a, sizeof a);
            memcpy(C[i + 1] + j, b, sizeof b);
            memcpy(C[i + 2] + j, c, sizeof c);
        }
}

static void transpose(int n, int m, rows *A, rows *restrict T)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++)
            T[j][i] = A[i][j];
}

static void swap_rows(rows a, rows b)
{
    rows kept;
    memcpy(kept, a, sizeof kept);
    memcpy(a, b, sizeof kept);
    memcpy(b, kept, sizeof kept);
}

/* X_i <- (X_i - sum W_ik X_k) f, over `from` <= k < `to`: a row of a triangular solution. */
static void substitute(int m, const real *row, int from, int to, real f, rows *X, real *target)
{
    for (int j = 0; j < m; j += TILE) {
        real sum[TILE];
        memcpy(sum, target + j, sizeof sum);
        for (int k = from; k < to; k++)
            for (int t = 0; t < TILE; t++)
                sum[t] -= row[k] * X[k][j + t];
        for (int t = 0; t < TILE; t++)
            target[j + t] = f * sum[t];
    }
}

/* X <- W^-1 X, and so Y unless it is NULL, of m columns; W = L U with row pivoting in the place of W.
   0 for a singular W. */
static int solve(int n, int m, rows *W, rows *X, rows *Y)
{
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (REAL(fabs)(W[i][k]) > REAL(fabs)(W[best][k]))
                best = i;
        if (!(REAL(fabs)(W[best][k]) > 0)) /* or NaN */
            return 0;
        if (best != k) {
            swap_rows(W[best], W[k]);
            swap_rows(X[best], X[k]);
            if (Y)
                swap_rows(Y[best], Y[k]);
        }
        for (int i = k + 1; i < n; i++) {
            real f = W[i][k] / W[k][k];
            for (int j = k + 1; j < n; j++)
                W[i][j] -= f * W[k][j];
            W[i][k] = f;
        }
    }
    for (int i = 1; i < n; i++) {
        substitute(m, W[i], 0, i, 1, X, X[i]);
        if (Y)
            substitute(m, W[i], 0, i, 1, Y, Y[i]);
    }
    for (int i = n - 1; i >= 0; i--) {
        substitute(m, W[i], i + 1, n, 1 / W[i][i], X, X[i]);
        if (Y)
            substitute(m, W[i], i + 1, n, 1 / W[i][i], Y, Y[i]);
    }
    return 1;
}

/* S <- S + D of symmetric matrices, of D what is not above the diagonal. */
static void add_symmetric(int n, rows *D, rows *S)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++)
            S[j][i] = S[i][j] += D[i][j];
}

static real norm(int n, rows *A)
{
    real sum = 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            sum += A[i][j] * A[i][j];
    return REAL(sqrt)(sum);
}

static void load(int n, int m, const real *from, rows *to)
{
    for (int i = 0; i < n; i++)
        memcpy(to[i], from + m * i, (size_t)m * sizeof(real));
}

/* w->H from w->A, w->G and w->H: the number of doublings, or 0.

   P - H_k = A_k' P (I + G_k P)^-1 A_k: no digit of P is missing once |A_k|^2 is that small. */
static int doubled(int n, stewart_riccati_work *w)
{
    for (int count = 1; count <= DOUBLINGS; count++) {
        multiply(n, n, n, WHOLE, w->G, w->H, w->W);
        for (int i = 0; i < n; i++)
            w->W[i][i] += 1;
        memcpy(w->left, w->A, sizeof w->A);
        memcpy(w->right, w->G, sizeof w->G);
        if (!solve(n, n, w->W, w->left, w->right))
            return 0;
        transpose(n, n, w->A, w->W);
        multiply(n, n, n, WHOLE, w->H, w->left, w->product);
        multiply(n, n, n, LOWER, w->W, w->product, w->other);
        add_symmetric(n, w->other, w->H);
        multiply(n, n, n, WHOLE, w->A, w->right, w->product);
        multiply(n, n, n, LOWER, w->product, w->W, w->other);
        add_symmetric(n, w->other, w->G);
        multiply(n, n, n, WHOLE, w->A, w->left, w->product);
        memcpy(w->A, w->product, sizeof w->A);
        real left = norm(n, w->A);
        if (left < VANISHED)
            return count;
        if (!isfinite(left))
            return 0;
    }
    return 0;
}

/* (R + B'P B) K = B'P A, with A in w->A, B in w->W, P in w->H; K in w->right, P A in w->left. */
static int gain_of(int n, const real *R, stewart_riccati_work *w)
{
    transpose(n, INPUTS, w->W, w->closed);
    multiply(n, n, INPUTS, WHOLE, w->H, w->W, w->product);
    multiply(INPUTS, n, INPUTS, WHOLE, w->closed, w->product, w->other);
    for (int i = 0; i < INPUTS; i++)
        for (int j = 0; j < INPUTS; j++)
            w->other[i][j] += R[INPUTS * i + j];
    multiply(n, n, n, WHOLE, w->H, w->A, w->left);
    multiply(INPUTS, n, n, WHOLE, w->closed, w->left, w->right);
    return solve(INPUTS, n, w->other, w->right, NULL);
}

/* |E| / |P|, E = Q + A'P (A - B K) - P in w->other and A - B K in w->closed, with P A in w->left and
   K in w->right. */
static real residual(int n, const real *Q, stewart_riccati_work *w)
{
    multiply(n, INPUTS, n, WHOLE, w->W, w->right, w->closed);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            w->closed[i][j] = w->A[i][j] - w->closed[i][j];
    transpose(n, n, w->left, w->product);
    multiply(n, n, n, WHOLE, w->product, w->closed, w->other);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            w->other[i][j] += Q[n * i + j] - w->H[i][j];
    return norm(n, w->other) / norm(n, w->H);
}

/* One step of Newton's from the residual E: P <- P + sum F^k' E F^k, F = A - B K (Kleinman, 1968),
   twice as many terms at a time. */
static void corrected(int n, stewart_riccati_work *w)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            w->other[j][i] = w->other[i][j] = (w->other[i][j] + w->other[j][i]) / 2;
    for (int count = 0; count < DOUBLINGS && norm(n, w->closed) > (real)1e-3; count++) {
        transpose(n, n, w->closed, w->left);
        multiply(n, n, n, WHOLE, w->other, w->closed, w->product);
        multiply(n, n, n, LOWER, w->left, w->product, w->right);
        add_symmetric(n, w->right, w->other);
        multiply(n, n, n, WHOLE, w->closed, w->closed, w->product);
        memcpy(w->closed, w->product, sizeof w->closed);
    }
    add_symmetric(n, w->other, w->H);
}

int stewart_riccati(int n, const real *A, const real *B, const real *Q, const real *R, real *K,
                    real *P, stewart_riccati_work *w)
{
    load(n, INPUTS, B, w->W);
    transpose(n, INPUTS, w->W, w->right);
    load(INPUTS, INPUTS, R, w->other);
    if (!solve(INPUTS, n, w->other, w->right, NULL))
        return 0;
    multiply(n, INPUTS, n, WHOLE, w->W, w->right, w->G);
    load(n, n, A, w->A);
    load(n, n, Q, w->H);
    int count = doubled(n, w);
    if (!count)
        return 0;
    load(n, n, A, w->A);
    load(n, INPUTS, B, w->W);
    if (!gain_of(n, R, w))
        return 0;
    real left = residual(n, Q, w);
    if (!(left <= LARGEST_RESIDUAL)) /* or NaN */
        return 0;
    if (left > NOTED_RESIDUAL) {
        corrected(n, w);
        if (!gain_of(n, R, w))
            return 0;
    }
    for (int i = 0; i < INPUTS; i++)
        memcpy(K + n * i, w->right[i], (size_t)n * sizeof(real));
    for (int i = 0; P && i < n; i++)
        memcpy(P + n * i, w->H[i], (size_t)n * sizeof(real));
    return count;
}
