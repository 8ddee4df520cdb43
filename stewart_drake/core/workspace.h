/* What law.c computes in. */

#ifndef STEWART_WORKSPACE_H
#define STEWART_WORKSPACE_H

#include "stewart.h"

/* Of the filter: f of a state and the parameters, F = [Phi S; 0 1] its derivative. */
typedef struct {
    real mean[STEWART_MEANS], covariance[STEWART_MEANS * STEWART_MEANS];
} stewart_estimate;

typedef struct {
    stewart_estimate prior, found, alone; /* of an attempt, and without the measurement */
    real A[2][144], B[72], G[2][96];       /* of d state/dt, at the nodes */
    real omega[144], turned[96], hold[144], hold_S[96]; /* of one torque */
    real H[12 * STEWART_MEANS], HP[12 * STEWART_MEANS], gain[STEWART_MEANS * 12];
    real S[144], factors[144];
    real keep[STEWART_MEANS * STEWART_MEANS], product[STEWART_MEANS * STEWART_MEANS];
    real posterior[STEWART_MEANS * STEWART_MEANS];
} stewart_filter_work;

struct stewart_workspace {
    union {
        stewart_filter_work filter;
        stewart_riccati_work riccati;
    } part;
    real power[5][144];                        /* of the matrix exponential */
    real A[144], B[72];                        /* the model's */
    real phi[2][144], input[2][72];            /* sampled, before and after eta0 */
    real M[36], right[6 * 26];                 /* equations to be solved for derivatives */
    real dF_dx[72], dF_dp[6 * STEWART_PARAMETERS], arm[36];
    real order_A[STEWART_MAX_ORDER * STEWART_MAX_ORDER];
    real order_Q[STEWART_MAX_ORDER * STEWART_MAX_ORDER];
    real order_B[STEWART_MAX_ORDER * STEWART_MOTORS], R[STEWART_MOTORS * STEWART_MOTORS];
    real K[STEWART_MOTORS * STEWART_MAX_ORDER];
    real reference[STEWART_PREVIEW * STEWART_REFERENCE]; /* with numbers for what is missing */
    real preview[STEWART_PREVIEW * STEWART_REFERENCE];   /* what is followed */
    real way[STEWART_PREVIEW * STEWART_REFERENCE];       /* without the given preview */
};

#endif
