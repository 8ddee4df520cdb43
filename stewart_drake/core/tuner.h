/* Weights of the law at run time: what they are decided by, and who decides. */

#pragma once

#include "law.h"

#define STEWART_WINDOW 31 /* samples that a decision rests on */
#define STEWART_FEATURES 18

/* Who decides: a network as the paper has it, which moves each weight by a factor; a network that has
   a start and moves along the ratio w_Q / w_R; or a rule of two lines for that ratio. */
enum { STEWART_PAPER_NETWORK, STEWART_RATIO_NETWORK, STEWART_RULE };

typedef struct {
    int health;         /* whether features are of health, else the paper's densities */
    int is_signed;      /* whether densities have a sign */
    real noise[STEWART_STATES];     /* standard deviation of a measurement */
    real motion[STEWART_STATES];    /* half the peak to peak of the reference, and that per second */
    real tolerance[STEWART_STATES]; /* tolerable error */
    real torque;        /* largest that the reference takes, N m */
    int doubts;         /* whether parameters are estimated */
    real prior[STEWART_MAX_ESTIMATED]; /* standard deviations of the parameters */
    real delay;         /* believed delay times the reference's angular frequency */
    int policy;
    real first[2];      /* weights of the first sample, and to go back to */
    real ratio, slope, knee; /* of the rule */
    int hidden, logarithms;  /* neurons; whether the network gives logarithms of weights */
    const real *input_mean, *input_scale; /* (18) */
    const real *W1, *b1, *W2, *b2;        /* (hidden, 18), (hidden), (2, hidden), (2) */
    real bounds[4];     /* lower, then upper ones of w_Q and w_R */
} stewart_tuner;

/* Numbers of the tuner's memory: weights of the last sample, fallbacks, the window. */
int stewart_tuner_memory(const stewart_tuner *tuner);

void stewart_tuner_start(const stewart_tuner *tuner, real *memory);

/* The newest row of the window, and its length. */
int stewart_newest_row(const stewart_tuner *tuner, const real *memory, real *row);

/* Weights (2) of the next sample. Returns whether who decides had to be passed over. */
int stewart_decide(const stewart_tuner *tuner, const real *memory, real *weights);

/* `stewart_step` with weights of a tuner, which observes it: `wanted` (12) is the reference's pose and
   rates at the sample; those of `sample` do not count. */
int stewart_tuned_step(const stewart_law *law, const stewart_tuner *tuner, real *memory,
                       real *tuner_memory, real *scratch, stewart_sample *sample,
                       const real *wanted, real *torque);

int stewart_tuned_step_scratch(const stewart_law *law);
