/* The type of all numbers. Its functions are those of <tgmath.h>, which go by it. */

#ifndef STEWART_REAL_H
#define STEWART_REAL_H

#include "limits.h"

#ifdef STEWART_FLOAT
typedef float real;
#else
typedef double real;
#endif

#endif
