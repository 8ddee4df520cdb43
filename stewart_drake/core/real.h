/* The type of all numbers, and the functions of <math.h> for it: REAL(sqrt)(x). */

#pragma once

#include <math.h>


#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math and -ffinite-math-only: they remove the checks for NaN and infinity"
#endif

/* Also compile a function for AVX2, where the library's loader can choose. Without fused operations both
   versions have the same results. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

#ifdef STEWART_FLOAT
typedef float real;
#define REAL(function) function##f
#else
typedef double real;
#define REAL(function) function
#endif
