/* Weights of the law at run time: features of the loop, and policies that decide by them. */

#pragma once

#include "law.h"

#define STEWART_WINDOW 31 /* samples on which a decision is based */
#define STEWART_FEATURES 18

/* Policies: the paper's network, which limits the factor from each weight to the next; a network that moves
   the ratio w_Q / w_R; a piecewise linear rule for that ratio; or fixed weights. */
enum { STEWART_PAPER_NETWORK, STEWART_RATIO_NETWORK, STEWART_RULE, STEWART_FIXED_WEIGHTS };

typedef struct {
    int health;         /* whether the features are those of health (tuner.c), else the paper's densities */
    int is_signed;      /* whether densities have a sign */
    real noise[STEWART_STATES];     /* standard deviation of a measurement */
    real motion[STEWART_STATES];    /* half the peak to peak of the reference, and that per second */
    real tolerance[STEWART_STATES]; /* tolerable error */
    real torque;        /* largest torque along the reference, N m */
    int doubts;         /* whether parameters are estimated */
    real prior[STEWART_MAX_ESTIMATED]; /* standard deviations of the parameters */
    real delay;         /* assumed delay times the reference's angular frequency */
    int policy;
    real first[2];      /* weights of the first sample, and where the policy fails */
    real ratio, slope, knee; /* of the rule */
    int hidden, logarithms;  /* neurons; whether the network gives logarithms of weights */
    const real *input_mean, *input_scale; /* (18) */
    const real *W1, *b1, *W2, *b2;        /* (hidden, 18), (hidden), (2, hidden), (2) */
    real bounds[4];     /* lower, then upper ones of w_Q and w_R */
} stewart_tuner;

/* Inputs of a tuner, from the law at a sample and at the sample before. */
typedef struct {
    const stewart_machine *machine;
    const real *state, *theta; /* estimated at the sample before; NaN without an estimate */
    stewart_schedule schedule; /* torques since then */
    const real *following;     /* the torque that acts next */
    const real *measured;      /* (12) state at the sample: the measurement, or the estimate with encoders */
    const real *torque[2], *feedforward[2]; /* of the sample, and of the one before */
    const real *std;           /* (p) of the estimated parameters */
} stewart_tuner_input;

/* Return the size of the tuner's memory: weights of the last sample, number of fallbacks, the window
   (31, columns) with the newest row last. */
int stewart_tuner_memory(const stewart_tuner *tuner);

void stewart_tuner_start(const stewart_tuner *tuner, real *memory);

/* Compute the features (18) of a window. */
void stewart_tuner_features(const stewart_tuner *tuner, const real *window, real *values);

/* Compute the weights (2) of the next sample. Returns whether the policy failed and the weights fall back. */
int stewart_decide(const stewart_tuner *tuner, const real *memory, real *weights);

/* The same for given features (18) and weights (2) of the last sample. */
int stewart_decide_by(const stewart_tuner *tuner, const real *values, const real *last, real *weights);

/* Add a sample to the memory: `wanted` (12) has the reference's pose and rates, `weights` (2) are those that
   were used. Scratch: 12 numbers for each torque of the schedule. */
void stewart_tuner_observe(const stewart_tuner *tuner, real *memory, const stewart_tuner_input *input,
                           const real *wanted, const real *weights, int fell_back,
                           stewart_scratch scratch);

/* Call `stewart_step` with the weights of a tuner, which it writes to `sample`, and add the sample to the
   tuner's memory. */
int stewart_tuned_step(const stewart_law *law, const stewart_tuner *tuner, real *memory,
                       real *tuner_memory, real *scratch, stewart_sample *sample,
                       const real *wanted, real *torque);

int stewart_tuned_step_scratch(const stewart_law *law);
