/* Small matrices, stored by rows. */

#ifndef STEWART_MATRIX_H
#define STEWART_MATRIX_H

#include "scratch.h"

int stewart_all_finite(int n, const real *x);
void stewart_copy(int n, const real *from, real *to);
void stewart_fill(int n, real value, real *x);

/* C = A B, (n, k) (k, m). */
void stewart_multiply(int n, int k, int m, const real *A, const real *B, real *restrict C);

/* C = A' B, (k, n)' (k, m). */
void stewart_multiply_transpose(int n, int k, int m, const real *A, const real *B,
                                real *restrict C);

/* C = A B', (n, k) (m, k)'. */
void stewart_multiply_by_transpose(int n, int k, int m, const real *A, const real *B,
                                   real *restrict C);

/* Two rows of a product, which all products of this file are made of:

       c_ij <- (c_ij +) sum_p a_ip b_pj,   j < columns,

   a_0p and a_1p `next` numbers apart, the rows of b (k) `m` numbers apart. c may be rows of b beyond
   its first k ones. */
enum { STEWART_SET, STEWART_ADD, STEWART_SUBTRACT };
void stewart_two_rows(int how, int k, const real *a0, const real *a1, int next, const real *b,
                      int m, int columns, real *c0, real *c1);

/* B <- A^-1 B, (n, n) (n, m), by elimination with row pivoting; A is lost. Returns 0 for a singular
   A. */
int stewart_solve(int n, int m, real *A, real *restrict B);

/* A <- L, lower triangular, with L L' = A (n, n), which is symmetric; only its lower triangle is
   read. Returns 0 where A is not positive definite. */
int stewart_cholesky(int n, real *A);

/* A <- R of A = Q R (m, n), m >= n, by Householder reflections: R is upper triangular in the first n
   rows, the rest is 0. */
void stewart_triangularize(int m, int n, real *A);

/* Phi = exp(A) (n, n), S = int_0^1 exp(A s) ds B (n, m). */
void stewart_exponential(int n, int m, const real *A, const real *B, real *Phi, real *S,
                         stewart_scratch scratch);

#endif
