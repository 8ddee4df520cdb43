/* The type of all numbers, and the functions of <math.h> for it: REAL(sqrt)(x). */

#pragma once

#include <math.h>


#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math and -ffinite-math-only: they remove the checks for NaN and infinity"
#endif

#ifdef STEWART_FLOAT
typedef float real;
#define REAL(function) function##f
#else
typedef double real;
#define REAL(function) function
#endif
