/* For who calls the law and its Riccati equation from another language (core/law_layout.py). */

#include "riccati.h"
#include "stewart.h"

#define EXPORT __attribute__((visibility("default")))

/* order, A, B, Q, R -> K, P by rows, and the number of doublings, 0 for a failure. */
EXPORT void riccati(double *b)
{
    stewart_riccati_work work;
    int n = (int)b[0];
    double *A = b + 1, *B = A + n * n, *Q = B + STEWART_INPUTS * n, *R = Q + n * n;
    double *K = R + STEWART_INPUTS * STEWART_INPUTS, *P = K + STEWART_INPUTS * n;
    P[n * n] = stewart_riccati(n, A, B, Q, R, K, P, &work);
}

/* The law of stewart.h, each call with a workspace of its own. */

EXPORT void law_sizes(int *sizes)
{
    sizes[0] = (int)sizeof(stewart_config);
    sizes[1] = (int)sizeof(stewart_memory);
}

EXPORT void law_init(const stewart_config *config, stewart_memory *memory, const double *queue)
{
    stewart_init(config, memory, queue);
}

EXPORT int law_step(const stewart_config *config, stewart_memory *memory, const double *measurement,
                    int age, const double *preview, const double *weights, double *torque)
{
    stewart_workspace work;
    return stewart_step(config, memory, &work, measurement, age, preview, weights, torque);
}

EXPORT void law_sent(const stewart_config *config, stewart_memory *memory, const double *torque)
{
    stewart_sent(config, memory, torque);
}
