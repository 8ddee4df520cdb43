/* Small matrices, stored by rows, and scratch memory from one block of the caller. */

#pragma once

#include <stddef.h>

#include "real.h"

/* Passed by value: memory that a function takes is free again when it returns. The caller of the outermost
   function provides enough; nothing is checked. */
typedef struct {
    real *next;
} stewart_scratch;

static inline real *stewart_take(stewart_scratch *scratch, int numbers)
{
    real *taken = scratch->next;
    scratch->next += numbers;
    return taken;
}

int stewart_all_finite(int n, const real *x);
void stewart_copy(int n, const real *from, real *to);
void stewart_fill(int n, real value, real *x);
real stewart_dot(int n, const real *x, const real *y);
real stewart_norm(int n, const real *x);

/* x + low (n) += change (n): `low` is what rounding takes off x. */
void stewart_accumulate(int n, const real *change, real *x, real *low);
void stewart_transpose(int n, real *A);
void stewart_swap_rows(int n, real *a, real *b);

/* C = A B, (n, k) (k, m); C does not overlap A or B. */
void stewart_multiply(int n, int k, int m, const real *A, const real *B, real *C);

/* C = A' B, (k, n)' (k, m), and C = A B', (n, k) (m, k)'. */
void stewart_multiply_transpose(int n, int k, int m, const real *A, const real *B, real *C);
void stewart_multiply_by_transpose(int n, int k, int m, const real *A, const real *B, real *C);

/* Two rows of a product:

       c_ij <- (c_ij +) sum_p a_ip b_pj,   j < columns,

   a_0p and a_1p `next` numbers apart, the rows of b (k) `m` numbers apart. c may be rows of b beyond
   its first k ones. */
enum { STEWART_SET, STEWART_ADD, STEWART_SUBTRACT };
void stewart_two_rows(int how, int k, const real *a0, const real *a1, int next, const real *b,
                      int m, int columns, real *c0, real *c1);

/* B <- A^-1 B, (n, n) (n, m), by elimination with row pivoting; A is overwritten. Returns 0 if A is
   singular. */
int stewart_solve(int n, int m, real *A, real *B);

/* A <- L, lower triangular, with L L' = A (n, n); only the lower triangle of A is read. Returns 0 if A
   is not positive definite. */
int stewart_cholesky(int n, real *A);

/* Phi = exp(A) (n, n), S = int_0^1 exp(A s) ds B (n, m). */
void stewart_exponential(int n, int m, const real *A, const real *B, real *Phi, real *S,
                         stewart_scratch scratch);
