/* Place to compute in, taken from one block that the caller has. */

#pragma once

#include <stddef.h>

#include "real.h"

/* Passed by value: what a function takes is free again when it returns. The caller of the outermost
   function knows how much is needed at the most, so that nothing is checked here. */
typedef struct {
    real *next;
} stewart_scratch;

static inline real *stewart_take(stewart_scratch *scratch, int numbers)
{
    real *taken = scratch->next;
    scratch->next += numbers;
    return taken;
}
