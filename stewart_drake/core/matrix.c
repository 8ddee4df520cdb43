#include <string.h>

#include "matrix.h"

int stewart_all_finite(int n, const real *x)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

void stewart_copy(int n, const real *from, real *to)
{
    memcpy(to, from, (size_t)n * sizeof(real));
}

void stewart_fill(int n, real value, real *x)
{
    for (int i = 0; i < n; i++)
        x[i] = value;
}

real stewart_dot(int n, const real *x, const real *y)
{
    real sum = 0;
    for (int i = 0; i < n; i++)
        sum += x[i] * y[i];
    return sum;
}

real stewart_norm(int n, const real *x) { return REAL(sqrt)(stewart_dot(n, x, x)); }

void stewart_accumulate(int n, const real *change, real *x, real *low)
{
    for (int i = 0; i < n; i++) {
        const real sum = low[i] + change[i], before = x[i];
        x[i] += sum;
        low[i] = sum - (x[i] - before);
    }
}

void stewart_transpose(int n, real *A)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++) {
            const real a = A[n * i + j];
            A[n * i + j] = A[n * j + i];
            A[n * j + i] = a;
        }
}

/* c <- (c +) s: one sum of a tile. */
static inline void put(int how, real s, real *c)
{
    *c = how == STEWART_SET ? s : how == STEWART_ADD ? *c + s : *c - s;
}

/* Six columns of two rows at a time, as twelve named sums: a compiler keeps these in the 16 double registers
   of a Cortex-M, but not sums in an array. The endless loop prevents vectors over p; vectors are for several j. */
void stewart_two_rows(int how, int k, const real *a0, const real *a1, int next, const real *b,
                      int m, int columns, real *c0, real *c1)
{
    int j = 0;
    if (k < 1)
        return;
    for (; j + 6 <= columns; j += 6, c0 += 6, c1 += 6) {
        const real *x = a0, *y = a1, *row = b + j, *last = row + m * (k - 1);
        real s0 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0, s5 = 0;
        real t0 = 0, t1 = 0, t2 = 0, t3 = 0, t4 = 0, t5 = 0;
        for (;; x += next, y += next, row += m) {
            const real u = *x, v = *y;
            s0 += u * row[0];
            t0 += v * row[0];
            s1 += u * row[1];
            t1 += v * row[1];
            s2 += u * row[2];
            t2 += v * row[2];
            s3 += u * row[3];
            t3 += v * row[3];
            s4 += u * row[4];
            t4 += v * row[4];
            s5 += u * row[5];
            t5 += v * row[5];
            if (row == last)
                break;
        }
        put(how, s0, c0);
        put(how, s1, c0 + 1);
        put(how, s2, c0 + 2);
        put(how, s3, c0 + 3);
        put(how, s4, c0 + 4);
        put(how, s5, c0 + 5);
        put(how, t0, c1);
        put(how, t1, c1 + 1);
        put(how, t2, c1 + 2);
        put(how, t3, c1 + 3);
        put(how, t4, c1 + 4);
        put(how, t5, c1 + 5);
    }
    for (; j < columns; j++, c0++, c1++) {
        const real *x = a0, *y = a1, *row = b + j;
        real s = 0, t = 0;
        for (int p = 0; p < k; p++, x += next, y += next, row += m) {
            s += *x * *row;
            t += *y * *row;
        }
        put(how, s, c0);
        put(how, t, c1);
    }
}

/* C = A B of rows of A that begin `row` numbers apart, their elements `next`; an odd last row is computed
   twice. */
static void product(int n, int k, int m, const real *A, int row, int next, const real *B, real *C)
{
    for (int i = 0; i < n; i += 2) {
        const int j = i + 1 < n ? i + 1 : i;
        stewart_two_rows(STEWART_SET, k, A + row * i, A + row * j, next, B, m, m, C + m * i, C + m * j);
    }
}

void stewart_multiply(int n, int k, int m, const real *A, const real *B, real *restrict C)
{
    product(n, k, m, A, k, 1, B, C);
}

void stewart_multiply_transpose(int n, int k, int m, const real *A, const real *B, real *restrict C)
{
    product(n, k, m, A, 1, n, B, C);
}

void stewart_multiply_by_transpose(int n, int k, int m, const real *A, const real *B,
                                   real *restrict C)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++)
            C[m * i + j] = stewart_dot(k, A + k * i, B + k * j);
}

void stewart_swap_rows(int n, real *a, real *b)
{
    for (int j = 0; j < n; j++) {
        const real a_j = a[j];
        a[j] = b[j];
        b[j] = a_j;
    }
}

int stewart_solve(int n, int m, real *A, real *restrict B)
{
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (REAL(fabs)(A[n * i + k]) > REAL(fabs)(A[n * best + k]))
                best = i;
        if (!(REAL(fabs)(A[n * best + k]) > 0)) /* or NaN */
            return 0;
        stewart_swap_rows(n, A + n * best, A + n * k);
        stewart_swap_rows(m, B + m * best, B + m * k);
        for (int i = k + 1; i < n; i++) {
            real f = A[n * i + k] / A[n * k + k];
            for (int j = k + 1; j < n; j++)
                A[n * i + j] -= f * A[n * k + j];
            for (int j = 0; j < m; j++)
                B[m * i + j] -= f * B[m * k + j];
        }
    }
    for (int i = n - 1; i >= 0; i--) { /* back substitution */
        for (int k = i + 1; k < n; k++)
            for (int j = 0; j < m; j++)
                B[m * i + j] -= A[n * i + k] * B[m * k + j];
        for (int j = 0; j < m; j++)
            B[m * i + j] /= A[n * i + i];
    }
    return 1;
}

int stewart_cholesky(int n, real *A)
{
    for (int j = 0; j < n; j++) {
        real *row = A + n * j, square = row[j];
        for (int k = 0; k < j; k++)
            square -= row[k] * row[k];
        if (!(square > 0)) /* or NaN */
            return 0;
        row[j] = REAL(sqrt)(square);
        for (int i = j + 1; i < n; i++) {
            real *below = A + n * i, sum = below[j];
            for (int k = 0; k < j; k++)
                sum -= below[k] * row[k];
            below[j] = sum / row[j];
        }
        for (int i = j + 1; i < n; i++)
            row[i] = 0;
    }
    return 1;
}

/* With phi(A) = sum A^k / (k+1)!,  exp(A) = 1 + A phi(A) and S = phi(A) B. The sum is taken for
   |A| / 2^s <= 1/2 up to k = 11; the rest is below 1/2^12 / 13! = 4e-14. It is taken in blocks of three, by
   Horner's rule in A^3, and then doubled s times: S <- (1 + Phi) S, Phi <- Phi^2. */
#define MOST_DOUBLINGS 60 /* ends the loop for an infinite A */
void stewart_exponential(int n, int m, const real *A, const real *B, real *Phi, real *S,
                         stewart_scratch scratch)
{
    static const real factorials[12] = {1,    2,     6,      24,      120,      720,
                                        5040, 40320, 362880, 3628800, 39916800, 479001600};
    real *A1 = stewart_take(&scratch, n * n), *A2 = stewart_take(&scratch, n * n);
    real *A3 = stewart_take(&scratch, n * n), *sum = stewart_take(&scratch, n * n);
    real *next = stewart_take(&scratch, n * (n > m ? n : m));
    real size = 0, scale = 1; /* 1-norm of A, 2^-s */
    int doublings = 0;
    for (int j = 0; j < n; j++) {
        real column = 0;
        for (int i = 0; i < n; i++)
            column += REAL(fabs)(A[n * i + j]);
        size = column > size ? column : size;
    }
    for (; size * scale > (real)0.5 && doublings < MOST_DOUBLINGS; doublings++)
        scale /= 2;
    for (int i = 0; i < n * n; i++)
        A1[i] = scale * A[i];
    stewart_multiply(n, n, n, A1, A1, A2);
    stewart_multiply(n, n, n, A2, A1, A3);
    for (int block = 9; block >= 0; block -= 3) { /* sum <- sum A^3 + 1/f_0 + A/f_1 + A^2/f_2 */
        const real *f = factorials + block;
        if (block < 9)
            stewart_multiply(n, n, n, sum, A3, next);
        else
            stewart_fill(n * n, 0, next);
        for (int i = 0; i < n * n; i++)
            sum[i] = next[i] + A1[i] / f[1] + A2[i] / f[2];
        for (int i = 0; i < n; i++)
            sum[(n + 1) * i] += 1 / f[0];
    }
    stewart_multiply(n, n, n, A1, sum, Phi);
    for (int i = 0; i < n; i++)
        Phi[(n + 1) * i] += 1;
    stewart_multiply(n, n, m, sum, B, S);
    for (int i = 0; i < n * m; i++)
        S[i] *= scale;
    for (; doublings > 0; doublings--) {
        stewart_multiply(n, n, m, Phi, S, next);
        for (int i = 0; i < n * m; i++)
            S[i] += next[i];
        stewart_multiply(n, n, n, Phi, Phi, next);
        stewart_copy(n * n, next, Phi);
    }
}
